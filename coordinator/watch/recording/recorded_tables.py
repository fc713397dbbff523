"""The tables of a recording, row by row, from the entries of a log. Knows no file format but that of the log.

Voltages are p.u. in ``states`` and ``buses``; where the area is known, kV, kW, kvar and A stand beside them and in
``branches``. Every time is s since 1970 UTC.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from agents.messages.checks import LONGEST_NAME, LONGEST_NOTE, MessageError, shown
from agents.messages.keys import NAME, incarnation_of, name_of_live, run_of
from agents.messages.packing import (
    MAX_BYTES,
    CommandMessage,
    Incarnation,
    ReadingsMessage,
    StateMessage,
    decode_recorded,
)
from agents.protocol.configuration import Configuration
from agents.protocol.quality import GOOD
from coordinator.watch.observe.area_flows import make_area_flows
from coordinator.watch.observe.freshness import freshness_of_state
from coordinator.watch.recording.entries import APPEARED, LEFT, MESSAGE, NOTE, VANISHED, Entry
from coordinator.watch.recording.recorder import check_sender
from coordinator.watch.recording.row_checks import LATEST
from dsse_core.errors import InvalidInputError

TIME, INTEGER, NUMBER, TRUTH, TEXT, TEXTS = "time", "integer", "number", "truth", "text", "texts"

FLOWS = ("p_from_kw", "q_from_kvar", "i_from_a", "p_to_kw", "q_to_kvar", "i_to_a", "loss_kw", "loss_kvar")
_WHOSE = {"time": TIME, "scan": INTEGER, "area": TEXT, "incarnation": TEXT}
_ESTIMATE = _WHOSE | {"estimate": INTEGER, "final": TRUTH}
_NUMBERS = {"quality": TEXT, "value_age_s": NUMBER}
COLUMNS: Mapping[str, Mapping[str, str]] = {
    "states": _ESTIMATE
    | {
        "sequence": INTEGER,
        "sent_at": TIME,
        "taken_at": TIME,
        "quality": TEXT,
        "notes": TEXTS,
        "estimated": TRUTH,
        "referenced": TRUTH,
        "checked": TRUTH,
        "objective": NUMBER,
        "degrees_of_freedom": INTEGER,
        "removed": TEXTS,
        "critical": TEXTS,
        "meters_off": TEXTS,
        "switches": TEXT,
        "taps": TEXT,
        "telemetry_age_s": NUMBER,
        "oldest_reading_s": NUMBER,
        "messages": INTEGER,
        "bytes": INTEGER,
        "lost": INTEGER,
        "rejected": TEXT,
        "faults": TEXT,
        "ages_s": TEXT,
        "scans": TEXT,
        "clock_skews_s": TEXT,
        "old_sides": TEXTS,
        "split": TEXT,
        "split_at": TIME,
        "split_edited": TEXT,
    },
    "buses": _ESTIMATE
    | {
        "bus": INTEGER,
        "phase": TEXT,
        "vm_pu": NUMBER,
        "va_deg": NUMBER,
        "sigma_vm_pu": NUMBER,
        "sigma_va_deg": NUMBER,
        "vm_kv": NUMBER,
        "p_kw": NUMBER,
        "q_kvar": NUMBER,
        "injection_problem": TEXT,
    }
    | _NUMBERS,
    "branches": _ESTIMATE
    | {"branch": TEXT, "from_bus": INTEGER, "to_bus": INTEGER, "phase": TEXT}
    | dict.fromkeys((*FLOWS, "loading_percent"), NUMBER)
    | _NUMBERS,
    "readings": _WHOSE
    | {
        "sequence": INTEGER,
        "taken_at": TIME,
        "meter": TEXT,
        "value": NUMBER,
        "sigma": NUMBER,
        "measured_at": TIME,
        "estimate": NUMBER,
        "normalised_residual": NUMBER,
    },
    "events": {"time": TIME, "event": TEXT, "role": TEXT, "name": TEXT, "scan": INTEGER, "details": TEXT},
}
"""Table -> its columns and the type of each."""
ADDED: Mapping[str, tuple[str, ...]] = {
    "readings": ("estimate", "normalised_residual"),
    "states": ("split", "split_at", "split_edited", "switches", "taps"),
    "buses": ("injection_problem", *_NUMBERS, "phase"),
    "branches": (*_NUMBERS, "phase"),
}
"""Table -> columns that files of earlier recorders lack."""

Row = tuple[str, tuple[Any, ...]]
"""A table, and a value for each of its columns; None where the value is not known."""


@dataclass
class _Shown:
    """The last state of an area, held back until the next one tells whether it was the last state of its scan.

    ``best``: the last good state with the same estimate, else the last one; its freshness is that of the numbers.
    """

    row: dict[str, Any]
    state: StateMessage
    best: StateMessage
    estimate: dict[str, list[dict[str, Any]]] = field(default_factory=dict)  # rows that are not handed out yet


class RowMaker:
    """Makes rows from entries in the order of a log of ``run``. ``files``: area files, as far as they are known."""

    def __init__(self, run: str, files: Iterable[Configuration] = ()) -> None:
        self._run = run
        self._areas = {content.area.name: content.area for content in files}
        self._shown: dict[str, _Shown] = {}
        self._qualities: dict[str, tuple[str, tuple[str, ...]]] = {}

    def rows_of(self, entry: Entry | str, where: str = "") -> Iterator[Row]:
        """The rows that follow from an entry, or from the text on a lost part of a log.

        ``where``: position of the entry in the log, for the details of events.
        """
        if isinstance(entry, str):
            yield _event(math.nan, "damaged log", "recorder", "", entry)
            return
        try:
            _check_entry(entry, self._run)
            if entry.kind == MESSAGE:
                message = decode_recorded(entry.payload)
                check_sender(entry.key, message, self._run)
        except MessageError as error:  # of another version of this program, or foreign
            at = entry.at if -LATEST <= entry.at < LATEST else math.nan
            yield _event(at, "unreadable", "recorder", entry.key[:LONGEST_NAME], f"{where}{error}")
            return
        if entry.kind == MESSAGE:
            yield from self._rows_of_message(entry.at, message)
        elif entry.kind == NOTE:
            yield _event(entry.at, entry.key, "recorder", "", entry.payload.decode("utf-8", "replace"))
        else:
            role, name = name_of_live(entry.key)
            why = entry.payload.decode("ascii", "replace") if entry.kind == LEFT else entry.key.rpartition("/")[2]
            yield _event(entry.at, entry.kind, role, name, why)

    def finish(self) -> Iterator[Row]:
        """The rows that were held back because their areas might have shown another state of the scan."""
        for last in self._shown.values():
            yield from self._hand_out(last, is_final=True)
        self._shown.clear()

    def _rows_of_message(self, at: float, message: object) -> Iterator[Row]:
        match message:
            case StateMessage():
                yield from self._rows_of_state(at, message)
            case ReadingsMessage():
                yield from _rows_of_readings(at, message)
            case CommandMessage():
                wanted = {
                    "meters_off": message.meters_off,
                    "meters_on": message.meters_on,
                    "scan": message.scan,
                    "stop": message.stop,
                    "opened": message.opened,
                    "closed": message.closed,
                }
                h = message.header
                details = wanted | {"sender": h.sender, "incarnation": str(h.incarnation), "sequence": h.sequence}
                yield _event(at, "command", "area", message.to, json.dumps(details))

    def _rows_of_state(self, at: float, state: StateMessage) -> Iterator[Row]:
        area = state.header.sender
        last = self._shown.get(area)
        self._shown[area] = shown = _Shown(_state_row(at, state), state, state)
        if last is not None and _has_same_estimate(last.state, state):
            shown.row["estimate"] = last.row["estimate"]
            shown.estimate, last.estimate = last.estimate, {}
            if last.best.quality == GOOD != state.quality:
                shown.best = last.best
        else:
            shown.estimate = self._describe_estimate(at, state)
        if last is not None:
            yield from self._hand_out(last, is_final=_place_of(last.state) != _place_of(state))

    def _hand_out(self, shown: _Shown, *, is_final: bool) -> Iterator[Row]:
        freshness = freshness_of_state(shown.best)
        of_numbers = {"quality": freshness.quality, "value_age_s": freshness.value_age_s}
        for table, rows in {"states": [shown.row], **shown.estimate}.items():
            for row in rows:
                row |= {"final": is_final} | (of_numbers if table != "states" else {})
                yield table, tuple(row.get(name) for name in COLUMNS[table])
        if is_final:  # in an earlier state, neighbours may not have finished the scan
            yield from self._find_events(shown.row["time"], shown.state)

    def _find_events(self, at: float, state: StateMessage) -> Iterator[Row]:
        area, scan = state.header.sender, state.header.scan
        quality, removed = self._qualities.get(area, ("", ()))
        self._qualities[area] = state.quality, state.removed
        if state.quality != quality:
            yield _event(at, "quality", "area", area, f"{state.quality}: {'; '.join(state.notes)}".rstrip(": "), scan)
        if state.removed != removed:
            yield _event(at, "removed meters", "area", area, " ".join(state.removed), scan)

    def _describe_estimate(self, at: float, state: StateMessage) -> dict[str, list[dict[str, Any]]]:
        """Rows of ``buses`` and ``branches`` without their column ``final``."""
        whose = _whose(at, state) | {"estimate": state.header.sequence}
        columns = state.nodes, state.vm, state.va, state.sigma_vm, state.sigma_va
        names = "bus", "phase", "vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg"
        buses = [
            whose
            | dict(zip(names, (bus, phase or None, vm, _degrees(va, state), s_vm, _degrees(s_va, state)), strict=True))
            for (bus, phase), vm, va, s_vm, s_va in zip(*columns, strict=True)
        ]
        area = self._areas.get(state.header.sender)
        if area is None or not buses:
            return {"buses": buses, "branches": []}
        try:
            of_buses, of_branches = make_area_flows(area, state)
        except InvalidInputError:  # the area has been changed, and the file has not
            return {"buses": buses, "branches": []}
        place = {node: k for k, node in enumerate(area.network.nodes)}
        for row in buses:
            at = place[row["bus"], row["phase"] or ""]
            row |= {key: float(of_buses[key][at]) for key in ("vm_kv", "p_kw", "q_kvar")}
            row["injection_problem"] = of_buses.injection_problem[at] or None
        keys = "branch", "from_bus", "to_bus", *FLOWS, "loading_percent"
        values = zip(*(list(of_branches[key]) for key in keys), strict=True)
        branches = [whose | dict(zip(keys, row, strict=True)) for row in values]
        for row, phase in zip(branches, of_branches.phase, strict=True):
            row["phase"] = phase if state.phases else None
        return {"buses": buses, "branches": branches}


def _check_entry(entry: Entry, run: str) -> None:
    """Checks that an entry of a log is one that a recorder of ``run`` writes.

    Raises:
        MessageError: naming the field.
    """
    if entry.kind not in (MESSAGE, APPEARED, VANISHED, LEFT, NOTE):
        raise MessageError("malformed", f"kind: {shown(entry.kind)} is no kind of entries")
    if not -LATEST <= entry.at < LATEST:
        raise MessageError("malformed", f"at: {entry.at:g} is no time of a calendar")
    if entry.kind == NOTE and len(entry.key) > LONGEST_NAME:
        raise MessageError("malformed", f"key: the event has a name of {len(entry.key)} characters")
    most = LONGEST_NOTE if entry.kind == LEFT else MAX_BYTES
    if len(entry.payload) > most:
        raise MessageError("malformed", f"payload: {len(entry.payload):,} bytes, the limit is {most:,}")
    if entry.kind in (APPEARED, VANISHED, LEFT):
        is_token = all(map(NAME.fullmatch, name_of_live(entry.key)))
        if run_of(entry.key) != run or not is_token or (entry.kind != LEFT and incarnation_of(entry.key) is None):
            raise MessageError("malformed", f"key: {shown(entry.key)} is no presence token of this run")


def _degrees(angle: float, state: StateMessage) -> float | None:
    """``angle``, rad, in degrees; None where the angles of ``state`` have no reference."""
    return math.degrees(angle) if state.referenced else None


def _place_of(state: StateMessage) -> tuple[Incarnation, int]:
    return state.header.incarnation, state.header.scan


def _has_same_estimate(one: StateMessage, other: StateMessage) -> bool:
    estimates = (
        (s.buses, s.phases, s.vm, s.va, s.sigma_vm, s.sigma_va, s.referenced, _place_of(s)) for s in (one, other)
    )
    return next(estimates) == next(estimates)


def _whose(at: float, message: StateMessage | ReadingsMessage) -> dict[str, Any]:
    h = message.header
    return {"time": at, "scan": h.scan, "area": h.sender, "incarnation": str(h.incarnation)}


def _state_row(at: float, state: StateMessage) -> dict[str, Any]:
    has_totals = bool(state.buses)
    return _whose(at, state) | {
        "estimate": state.header.sequence,
        "sequence": state.header.sequence,
        "sent_at": state.header.time,
        "taken_at": state.taken_at or None,
        "quality": state.quality,
        "notes": list(state.notes),
        "estimated": has_totals,
        "referenced": state.referenced,
        "checked": state.checked,
        "objective": state.objective if has_totals else None,
        "degrees_of_freedom": state.degrees_of_freedom if has_totals else None,
        "removed": list(state.removed),
        "critical": list(state.critical),
        "meters_off": list(state.meters_off),
        "switches": _as_text(state.switches),
        "taps": _as_text(state.taps),
        "telemetry_age_s": state.telemetry_age,
        "oldest_reading_s": state.oldest_reading,
        "messages": state.messages,
        "bytes": state.bytes,
        "lost": state.lost,
        "rejected": _as_text(state.rejected),
        "faults": _as_text(state.faults),
        "ages_s": _as_text(state.ages),
        "scans": _as_text(state.scans),
        "clock_skews_s": _as_text(state.clock_skews),
        "old_sides": list(state.old_sides),
        "split": state.split.digest or None,
        "split_at": state.split.time or None,
        "split_edited": state.split.edited or None,
    }


def _as_text(table: Mapping[str, Any]) -> str:
    return msgspec.json.encode(table).decode()


def _rows_of_readings(at: float, message: ReadingsMessage) -> Iterator[Row]:
    whose = tuple((_whose(at, message) | {"sequence": message.header.sequence, "taken_at": message.taken_at}).values())
    unknown = (None,) * (len(message.meters) - len(message.estimates))
    described = (*message.estimates, *unknown), (*message.normalised, *unknown)
    columns: Sequence[Sequence[Any]] = (message.meters, message.values, message.sigmas, message.times, *described)
    for reading in zip(*columns, strict=True):
        yield "readings", (*whose, *reading)
    if not message.meters:
        yield "readings", (*whose, *(None,) * len(columns))  # the area took none


def _event(at: float, event: str, role: str, name: str, details: str, scan: int | None = None) -> Row:
    return "events", (None if math.isnan(at) else at, event, role, name, scan, details)
