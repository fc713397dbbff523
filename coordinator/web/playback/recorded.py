"""A recording as a play: what areas have shown and used, and who came and went, in the order of its time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from agents.messages.keys import incarnation_of, live_key, name_of_live
from agents.messages.packing import NO_INCARNATION, Header, ReadingsMessage, StateMessage
from coordinator.recording.entries import APPEARED, VANISHED
from coordinator.recording.folder import list_segments, read_about
from coordinator.recording.rows import COLUMNS
from coordinator.replay.ticks import rows_of_segment
from coordinator.web.playback.play import MOST_VALUES, Play, Presence, Update, count_values
from coordinator.web.playback.source import PlaybackSource
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.split_identity import SplitIdentity
from scenarios.scenario import Scenario

MOST_UPDATES = 10_000  # the newest that are played

Row = Mapping[str, Any]
Timed = tuple[float, Update]


def play_recording(folder: Path, scenario: Scenario | None, notes: list[str]) -> PlaybackSource:
    """The recording at ``folder``, its newest part if it is long; what is lost or left out is added to ``notes``.

    Raises:
        InvalidInputError: it is no recording, nothing is in it, or it has Parquet and pyarrow is not installed.
    """
    run = read_about(folder).run
    kept: list[Timed] = []
    for segment in reversed(list_segments(folder)):
        found = _read_segment(folder, segment, run, notes)
        kept = [*found, *kept]
        newest = kept[_find_begin(kept) :]
        if len(newest) < len(kept):
            kept = newest
            notes.append("the recording is long: its newest part is played")
            break
    if not kept:
        raise InvalidInputError(str(folder), ["nothing is recorded here yet"])
    since = kept[0][0]
    remarks = [*dict.fromkeys(notes), *_find_lacking(item for _, item in kept)]
    kept = [*((since, token) for token in _find_there_before(kept, run)), *kept]
    play = Play(run=run, since=since, updates=[(at - since, item) for at, item in kept])
    return PlaybackSource(play, scenario, remarks)


def _find_lacking(updates: Iterable[Update]) -> Iterator[str]:
    """In words, what a page shows of a run and a recording does not hold."""
    yield "a recording holds no messages between areas"
    used = [item for item in updates if isinstance(item, ReadingsMessage) and item.meters]
    if not used:
        yield "this one holds no readings"
    elif not any(item.estimates for item in used):
        yield "this one holds no estimate and no residual of its readings"


def _find_begin(updates: list[Timed]) -> int:
    """The place of the first that is played."""
    values = 0
    for k in reversed(range(len(updates))):
        values += count_values(updates[k][1])
        if len(updates) - k > MOST_UPDATES or values > MOST_VALUES:
            return min(k + 1, len(updates) - 1)
    return 0


def _find_there_before(updates: list[Timed], run: str) -> Iterator[Presence]:
    """The tokens of areas that were there before the first that is played."""
    known = set[str]()
    for _, item in updates:
        if isinstance(item, Presence):
            known.add(name_of_live(item.key)[1])
        elif item.header.sender not in known:
            known.add(item.header.sender)
            yield Presence(live_key(run, "area", item.header.sender, item.header.incarnation), True)


def _read_segment(folder: Path, segment: str, run: str, notes: list[str]) -> list[Timed]:
    """All of one segment; the newest state of an estimate has its buses."""
    states: list[tuple[tuple[Any, ...], Timed]] = []
    buses: dict[tuple[Any, ...], dict[int, Row]] = {}
    readings: dict[tuple[Any, ...], list[Row]] = {}
    updates: list[Timed] = []
    try:
        for table, values in rows_of_segment(folder, segment):
            row = dict(zip(COLUMNS[table], values, strict=True))
            if table == "states":
                states.append((_whose(row), (row["time"], _to_state(row, run))))
            elif table == "buses":
                buses.setdefault(_whose(row), {})[row["bus"]] = row
            elif table == "readings":
                key = row["area"], row["incarnation"], row["sequence"], row["time"]
                readings.setdefault(key, []).append(row)
            elif table == "events" and row["event"] in (APPEARED, VANISHED):
                updates += _to_presence(row, run)
    except InvalidInputError as error:  # a foreign file, or one that is damaged; the others are read all the same
        notes.append(str(error))
    updates += [(at, _with_buses(item, buses.get(key, {}).values())) for key, (at, item) in states]
    updates += [(rows[0]["time"], _to_readings(rows, run)) for rows in readings.values()]
    return sorted(updates, key=lambda timed: timed[0])


def _whose(row: Row) -> tuple[Any, ...]:
    """The estimate that a row belongs to."""
    return row["area"], row["incarnation"], row["estimate"]


def _to_presence(row: Row, run: str) -> Iterator[Timed]:
    """Nobody's who has no incarnation, as LEFT, which says why instead; the token vanishes right after."""
    incarnation = incarnation_of(row["details"])
    if incarnation is not None:
        yield row["time"], Presence(live_key(run, row["role"], row["name"], incarnation), row["event"] == APPEARED)


def _to_header(row: Row, run: str) -> Header:
    incarnation = incarnation_of(row["incarnation"]) or NO_INCARNATION
    return Header(run, row["area"], incarnation, row["scan"], row["sequence"], row.get("sent_at") or row["time"])


def _to_state(row: Row, run: str) -> StateMessage:
    """Without its buses."""
    blank: dict[str, Any] = dict.fromkeys(("buses", "vm", "va", "sigma_vm", "sigma_va"), ())
    tables = {name: parse_json(row[key] or "{}") for name, key in _TABLES.items()}
    plain: dict[str, Any] = {name: tuple(row[name]) if isinstance(row[name], list) else row[name] for name in _SAME}
    return StateMessage(
        header=_to_header(row, run),
        **blank,
        **plain,
        **tables,
        objective=row["objective"] or 0.0,
        degrees_of_freedom=row["degrees_of_freedom"] or 0,
        sent=dict.fromkeys(tables["ages"], (0, 0)),
        received={},
        telemetry_age=row["telemetry_age_s"] or 0.0,
        oldest_reading=row["oldest_reading_s"] or 0.0,
        taken_at=row["taken_at"] or 0.0,
        split=SplitIdentity(row["split"] or "", row["split_at"] or 0.0, row["split_edited"] or ""),
    )


_TABLES = {
    "rejected": "rejected",
    "faults": "faults",
    "ages": "ages_s",
    "scans": "scans",
    "clock_skews": "clock_skews_s",
}
_SAME = tuple(
    field.name
    for field in fields(StateMessage)
    if field.name in COLUMNS["states"]
    and field.name not in (*_TABLES, "objective", "degrees_of_freedom", "taken_at", "split")
)


def _with_buses(state: Update, rows: Iterable[Row]) -> Update:
    if not isinstance(state, StateMessage) or not (found := list(rows)):
        return state

    def column(name: str, scale: float = 1.0) -> tuple[float, ...]:
        return tuple(0.0 if row[name] is None else scale * row[name] for row in found)

    return replace(
        state,
        buses=tuple(row["bus"] for row in found),
        vm=column("vm_pu"),
        va=column("va_deg", math.pi / 180),
        sigma_vm=column("sigma_vm_pu"),
        sigma_va=column("sigma_va_deg", math.pi / 180),
    )


def _to_readings(rows: list[Row], run: str) -> ReadingsMessage:
    """One row without a meter says that none was used."""
    given = [row for row in rows if row["meter"] is not None]
    described = [row for row in given if row["estimate"] is not None]
    given = [*described, *(row for row in given if row["estimate"] is None)]
    columns = {name: tuple(row[key] for row in given) for name, key in _OF_READINGS.items()}
    return ReadingsMessage(
        header=_to_header(rows[0], run),
        taken_at=rows[0]["taken_at"] or 0.0,
        **columns,
        estimates=tuple(row["estimate"] for row in described),
        normalised=tuple(math.nan if (off := row["normalised_residual"]) is None else off for row in described),
    )


_OF_READINGS = {"meters": "meter", "values": "value", "sigmas": "sigma", "times": "measured_at"}
