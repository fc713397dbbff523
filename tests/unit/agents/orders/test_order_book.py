"""Which commands of the operator are followed, and what of them outlives the process."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.messages.packing import CommandMessage, Header, Incarnation, encode
from agents.orders.order_book import BY_OPERATOR, LARGEST_COMMAND, OrderBook
from agents.orders.order_file import Followed, OrderFile
from agents.protocol.events import Event, Ordered, Rejected, StopRequested
from dsse_core.errors import InvalidInputError

NOW = 1_800_000_000.0  # s since 1970
START = Incarnation(int(1000 * NOW), 7)
METERS = ("M1", "M2", "M3")


def command(*meters_off: str, sequence: int = 1, to: str = "area1", **changes: Any) -> CommandMessage:
    """Of the operator; ``changes``: of its header."""
    header = replace(Header("run", "operator", START, 0, sequence, NOW), **changes)
    return CommandMessage(header, to, meters_off, (), scan=False, stop=False)


def on_again(*meters: str, sequence: int) -> CommandMessage:
    return replace(command(sequence=sequence), meters_on=meters)


def book(place: Path | None = None) -> OrderBook:
    return OrderBook("area1", "run", METERS, OrderFile.of(place / "area1.toml", "run", "area1") if place else None)


def take(orders: OrderBook, message: CommandMessage, wall: float = NOW) -> list[Event]:
    return list(orders.take(encode(message), wall))


def followed(sequence: int, *meters_off: str, scan: bool = False) -> Ordered:
    return Ordered((START.start_ms, START.random, sequence), meters_off, scan)


def test_a_command_is_followed_once_however_often_it_comes():
    orders = book()
    assert take(orders, command("M2")) == [followed(1, "M2")]
    assert take(orders, command("M2")) == []
    assert take(orders, replace(command(sequence=2), scan=True)) == [followed(2, "M2", scan=True)]
    assert take(orders, replace(command(sequence=2), scan=True)) == []


@pytest.mark.parametrize("restarts", [False, True])
def test_a_command_says_nothing_of_meters_that_it_does_not_name(tmp_path: Path, restarts: bool):
    orders = book(tmp_path)
    assert take(orders, command("M1", sequence=1)) == [followed(1, "M1")]
    orders = book(tmp_path) if restarts else orders
    other = Incarnation(START.start_ms, START.random + 1)  # of an operator who has not seen the first one
    assert take(orders, command("M2", incarnation=other)) == [Ordered((other.start_ms, 8, 1), ("M1", "M2"), False)]
    orders = book(tmp_path) if restarts else orders
    assert take(orders, replace(on_again("M1", sequence=2), header=replace(command().header, incarnation=other,
                sequence=2))) == [Ordered((other.start_ms, 8, 2), ("M2",), False)]  # fmt: skip


def test_meters_of_other_areas_are_no_business_of_this_one():
    assert take(book(), command("M3", "elsewhere", "M1")) == [followed(1, "M1", "M3")]


def test_a_process_is_stopped_once_what_was_ordered_is_recorded(tmp_path: Path):
    assert take(book(tmp_path), replace(command("M1"), stop=True)) == [followed(1, "M1"), StopRequested(BY_OPERATOR)]
    restarted = book(tmp_path)
    assert restarted.begin() == [followed(1, "M1")]
    assert take(restarted, replace(command("M1"), stop=True)) == [], "a replay must not stop it again"


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (command("M1", run="other"), "other run"),
        (command("M1", sender="area2"), "command of another process than the operator"),
        (command("M1", to="area2"), "command to another process"),
        (command("M1", time=NOW + 601), "command from the future"),
        (command("M1", incarnation=Incarnation(int(1000 * NOW) + 601_000, 1)), "command from the future"),
        (command("M1", time=NOW - 61), "command older than 60 s"),
    ],
)
def test_a_command_that_is_not_the_operators_to_this_area_now_is_rejected(message: CommandMessage, reason: str):
    orders = book()
    assert take(orders, message) == [Rejected(reason, 1)]
    assert take(orders, message) == [Rejected(reason, 2)]
    assert orders.begin() == []


@pytest.mark.parametrize("restarts", [False, True])
def test_a_command_of_the_past_is_rejected_also_after_a_restart(tmp_path: Path, restarts: bool):
    orders = book(tmp_path)
    off, on = command("M2", sequence=1), on_again("M2", sequence=2)
    assert take(orders, off) == [followed(1, "M2")]
    assert take(orders, on) == [followed(2)]
    orders = book(tmp_path) if restarts else orders
    assert take(orders, off) == [Rejected("command of the past", 1)]
    earlier = command("M1", incarnation=Incarnation(START.start_ms - 1, 9), sequence=5)
    assert take(orders, earlier) == [Rejected("command of the past", 2)]


def test_switches_stay_as_ordered_after_a_restart_and_those_of_other_areas_are_no_business_of_this_one(tmp_path: Path):
    def book() -> OrderBook:
        file = OrderFile.of(tmp_path / "area1.toml", "run", "area1")
        return OrderBook("area1", "run", METERS, file, switches=("S1", "S2"))

    take(book(), replace(command("M1"), opened=("S2", "elsewhere"), closed=("S1",)))
    order = START.start_ms, START.random
    assert book().begin() == [Ordered((*order, 1), ("M1",), switches={"S1": True, "S2": False})]
    assert take(book(), replace(command(sequence=2), closed=("S2",))) == [
        Ordered((*order, 2), ("M1",), switches={"S1": True, "S2": True})
    ]
    both = replace(command(sequence=3), opened=("S1",), closed=("S1",))
    assert take(book(), both) == [Rejected("command malformed", 1)]


def test_what_is_off_stays_off_after_a_restart(tmp_path: Path):
    take(book(tmp_path), command("M2", "M1"))
    assert book(tmp_path).begin() == [followed(1, "M1", "M2")]


def test_a_command_that_cannot_be_recorded_is_not_followed(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    orders = OrderBook("area1", "run", METERS, OrderFile.of(tmp_path / "gone" / "area1.toml", "run", "area1"))
    assert take(orders, command("M1")) == [Rejected("command that cannot be recorded", 1)]
    assert "run.area1.operator.json: No such file or directory" in caplog.text
    (tmp_path / "gone").mkdir()
    assert take(orders, command("M1")) == [followed(1, "M1")]


def test_a_process_without_a_file_follows_no_command_from_before_its_beginning():
    orders = OrderBook("plant", "run", began_at=NOW)
    assert take(orders, replace(command(to="plant", time=NOW - 1), stop=True)) == [Rejected("command of the past", 1)]
    assert take(orders, replace(command(to="plant"), scan=True)) == [followed(1, scan=True)]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [(b"rubbish", "command damaged"), (b"x" * (LARGEST_COMMAND + 1), "command too large")],
)
def test_what_is_no_message_is_counted(payload: bytes, reason: str):
    assert list(book().take(payload, NOW)) == [Rejected(reason, 1)]


def test_the_file_lies_in_the_state_directory_if_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    area_file = tmp_path / "areas" / "area1.toml"
    assert OrderFile.of(area_file, "run", "area1").path == tmp_path / "areas" / "run.area1.operator.json"
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path / 'state'}:{tmp_path / 'other'}")
    assert OrderFile.of(area_file, "run", "area1").path == tmp_path / "state" / "run.area1.operator.json"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "not valid JSON"),
        (json.dumps({"followed": [1, 2], "meters_off": []}), "followed"),
        (json.dumps({"followed": [1, 2, -3], "meters_off": []}), "followed[3]"),
        (json.dumps({"followed": [1, 2, 3]}), "meters_off: missing; ids of the meters that are switched off"),
    ],
)
def test_a_file_that_cannot_be_read_is_named_with_what_to_do(tmp_path: Path, text: str, expected: str):
    file = OrderFile(tmp_path / "run.area1.operator.json")
    file.path.write_text(text)
    with pytest.raises(InvalidInputError) as caught:
        OrderBook("area1", "run", METERS, file)
    assert str(file.path) in str(caught.value)
    assert expected in str(caught.value)
    assert "remove it: then no meter is off" in str(caught.value)


def test_a_file_brings_back_what_was_saved(tmp_path: Path):
    file = OrderFile(tmp_path / "run.area1.operator.json")
    assert file.load() == Followed()
    for saved in (Followed(START, 3, ("M1", "M 2 \N{MICRO SIGN}")), Followed(START, 4)):
        file.save(saved)
        assert file.load() == saved
    assert [path.name for path in tmp_path.iterdir()] == [file.path.name]


def test_an_operator_file_that_cannot_be_looked_for_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / ("x" * 300)))
    with pytest.raises(InvalidInputError, match=r"run\.area1\.operator\.json.*\n.*cannot be read: File name too long"):
        OrderFile.of(tmp_path / "area1.toml", "run", "area1").load()
