"""A scenario with some of its values replaced by key path, as ``dsse sweep`` loads it."""

from __future__ import annotations

import pytest

from dsse_core.errors import InvalidInputError
from scenarios.scenario import load_scenario


def test_a_changed_value_is_as_if_it_stood_in_the_file():
    links = load_scenario("ieee33", changes={"faults.loss": 0.3}).faults.links
    assert {link.loss for link in links.values()} == {0.3}
    assert load_scenario("ieee33-lossy", changes={"faults.loss": 0.0}).faults == load_scenario("ieee33").faults


def test_tables_that_the_file_does_not_have_are_made():
    assert load_scenario("ieee33", changes={"run.beat_s": 0.5}).run.beat_s == 0.5


def test_changes_without_keys_are_refused_with_their_form():
    with pytest.raises(InvalidInputError, match=r'changes: is a list; give keys and values, as \{"faults.loss": 0.3\}'):
        load_scenario("ieee33", changes=["faults.loss=0.3"])


def test_several_changes_and_items_of_lists_are_possible():
    link = [{"from": "area1", "to": "area2", "loss": 0.1}]
    scenario = load_scenario("ieee33", changes={"faults.link": link, "faults.link[1].loss": 0.7, "seed": 9})
    assert (scenario.faults.links["area1", "area2"].loss, scenario.seed) == (0.7, 9)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("faults.los", 0.1, "faults.los: unknown key; allowed here: loss"),
        ("faults.loss", 2, "must be less than or equal to 1, found 2"),
        ("faults.loss.more", 1, "faults.loss is no table"),
        ("areas.area1.buses[99]", 1, "areas.area1.buses is a list of 13"),
        ("areas.area1.buses[0]", 1, "areas.area1.buses is a list of 13; items count from 1"),
        ("areas[1]", 1, "areas is no list"),
        ("faults..loss", 1, "is no key; one looks like faults.loss"),
        ("", 1, "is no key"),
    ],
)
def test_a_change_that_cannot_be_made_names_its_key(key: str, value: object, message: str):
    with pytest.raises(InvalidInputError) as error:
        load_scenario("ieee33-lossy", changes={key: value})
    assert message in str(error.value)
