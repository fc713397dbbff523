"""What the page says has happened, from one look to the next."""

from __future__ import annotations

from dataclasses import replace

from coordinator.show.web.moment import Events, find_links
from coordinator.watch.observe.view import AreaView, View

BOTH = ("area1", "area2")


def seen(ages_s: dict[str, float], present: tuple[str, ...] = BOTH, estimated: bool = False) -> View:
    """Two areas; what ``ages_s`` says of each as a receiver is the age of what the other has sent."""
    others = {"area1": "area2", "area2": "area1"}
    areas = tuple(
        AreaView(
            name,
            name in present,
            0.1,
            quality="good",
            estimated=estimated,
            ages_s={other: ages_s[name]},
            neighbours=(other,),
        )
        for name, other in others.items()
    )
    return View("run", areas, (), (), (), 0)


def take(events: Events, at: float, view: View) -> None:
    events.take(at, view, find_links(view))


def kinds_of(events: Events) -> list[tuple[str, str]]:
    return [(event["area"], event["text"]) for event in events.kept if event["kind"] == "link"]


def test_a_link_that_is_cut_and_restored_is_reported_by_its_receiver():
    events, old = Events(), 1e6
    for at, age_s in enumerate((0.1, old, old, 0.1, 0.1)):
        take(events, float(at), seen({"area1": age_s, "area2": 0.1}))
    assert kinds_of(events) == [("area1", "receives nothing from area2"), ("area1", "receives from area2 again")]
    assert [event["time"] for event in events.kept if event["kind"] == "link"] == [1.0, 3.0]


def test_a_link_that_has_not_begun_yet_is_no_event():
    events = Events()
    for at, age_s in enumerate((1e6, 1e6, 0.1)):
        take(events, float(at), seen({"area1": age_s, "area2": 0.1}))
    assert kinds_of(events) == []


def test_a_link_without_which_an_area_estimates_from_the_begin_is_reported_as_dead():
    events = Events()
    for at, age_s in enumerate((1e6, 1e6, 0.1, 0.1)):
        take(events, float(at), seen({"area1": age_s, "area2": 0.1}, estimated=at > 0))
    assert kinds_of(events) == [("area1", "receives nothing from area2"), ("area1", "receives from area2")]


def test_of_an_area_that_is_gone_no_link_is_reported_to_stop():
    events, whole = Events(), seen({"area1": 0.1, "area2": 0.1})
    for view in (whole, seen({"area1": 1e6, "area2": 1e6}, present=("area1",)), seen({"area1": 1e6, "area2": 1e6})):
        take(events, 0.0, view)
    assert kinds_of(events) == []
    take(events, 1.0, whole)
    assert kinds_of(events) == [("area1", "receives from area2 again"), ("area2", "receives from area1 again")]


def test_the_time_between_scans_is_that_of_the_last_two():
    events, found = Events(), []
    for at, scan in ((0.0, 7), (1.0, 7), (2.5, 8), (2.6, 8), (8.5, 11)):
        view = seen({"area1": 0.1, "area2": 0.1})
        take(events, at, replace(view, areas=tuple(replace(area, scan=scan) for area in view.areas)))
        found.append(events.scan_s)
    assert found == [None, None, 2.5, 2.5, 2.0]
