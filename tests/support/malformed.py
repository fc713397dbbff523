"""Malformed recordings: each kind changes one good recording in one place. Kinds of logs, of tables, and of files."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import struct
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import pyarrow
import pyarrow.parquet

from agents.messages.keys import live_key, state_key
from agents.messages.packing import CommandMessage, Header, TelemetryMessage, encode, seal
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.entries import APPEARED, LEFT, MESSAGE, NOTE
from coordinator.watch.recording.folder import begin_writing
from coordinator.watch.recording.frames import MARK, frame
from coordinator.watch.recording.segment_log import SegmentLog
from tests.support.recordings import AT, ME, RUN, appeared, entry_of, load_areas_of, make_readings, make_state

AREAS = load_areas_of()
AREA = AREAS[0].area.name
SCANS = 2
STATE = make_state(AREAS[0])
READINGS = make_readings(AREAS[0])


def write_good(folder: Path, *, closed: bool) -> Path:
    """Two scans of three areas."""
    with begin_writing(folder, RUN, AREAS):
        log = SegmentLog(folder)
        entries = [appeared(content.area.name) for content in AREAS]
        for scan in range(1, SCANS + 1):
            for content in AREAS:
                when = AT + scan
                known = {"ages": {"area3": 0.5}, "rejected": {"damaged": 1}, "notes": ("a remark",)}
                entries += [entry_of(make_readings(content, scan, scan, when), when)]
                entries += [entry_of(make_state(content, scan, scan, when, **known), when)]
        log.write(entries)
        log.close()
    if closed:
        assert close_ended(folder) == []
    return folder


# Frames of logs


def log_in(folder: Path) -> Path:
    (path,) = (folder / "log").iterdir()
    return path


def add_frame(make: Callable[[], bytes], folder: Path) -> None:
    with log_in(folder).open("ab") as file:
        file.write(make())


def _body(body: object) -> bytes:
    return frame(msgpack.packb(body))


def _entry(kind: object = MESSAGE, at: object = AT, key: object = state_key(RUN, AREA), payload: object = b"") -> bytes:
    return _body([kind, at, key, payload])


def _message(message: Any, key: str = state_key(RUN, AREA)) -> bytes:
    return _entry(key=key, payload=encode(message))


def _place(k: int, value: object, message: Any = STATE) -> bytes:
    """A message of which place ``k`` holds ``value``."""
    places = msgpack.unpackb(encode(message)[:-4], use_list=True)
    places[k] = value
    return _entry(payload=seal(msgpack.packb(places)))


def _field(name: str, value: object) -> bytes:
    names = [field.name for field in dataclasses.fields(STATE)]
    return _place(2 + names.index(name), value)


def _header(**changes: object) -> bytes:
    return _message(dataclasses.replace(STATE, header=dataclasses.replace(STATE.header, **changes)))  # type: ignore[arg-type]


def _nested(depth: int) -> bytes:
    return b"\x91" * depth + b"\xc0"


def _flipped(message: bytes) -> bytes:
    return message[:-5] + bytes([message[-5] ^ 1]) + message[-4:]


def _count() -> int:
    return len(STATE.buses)


LOG_KINDS: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "frame that was not written to its end": (lambda: _message(STATE)[:-9], "not written to its end"),
    "frame with another checksum": (lambda: _message(STATE)[:-1] + b"\x00" + _message(STATE), "frames are damaged"),
    "frame longer than all are": (lambda: MARK + b"\xff" * 8 + _message(STATE), "frames are damaged"),
    "bytes between frames": (lambda: b"GET / HTTP/1.1\r\n\r\n" + _message(STATE), "frames are damaged"),
    "frame of no MessagePack": (lambda: frame(b"\xc1\xc1"), "no entry of this version"),
    "frame nested deeply": (
        lambda: frame(b"\x95" + b"\xa1x\xcb" + bytes(8) + b"\xa1y\xc4\x00" + _nested(100_000)),
        "no entry",
    ),
    "entry that is no array": (lambda: _body({"kind": MESSAGE}), "no entry of this version"),
    "entry that is too short": (lambda: _body([MESSAGE, AT]), "no entry of this version"),
    "kind that is a number": (lambda: _entry(kind=7), r"Expected `str`, got `int` - at `\$\[0\]`"),
    "kind that no recorder writes": (lambda: _entry(kind="massage"), "kind: .*massage"),
    "time that is text": (lambda: _entry(at="now"), r"Expected `float`, got `str` - at `\$\[1\]`"),
    "time that is nan": (lambda: _entry(NOTE, float("nan"), "lost"), "at: nan"),
    "time that is infinite": (lambda: _entry(NOTE, float("inf"), "lost"), "at: inf"),
    "time beyond calendars": (lambda: _entry(APPEARED, 1e300, live_key(RUN, "area", AREA, ME)), r"at: 1e\+300"),
    "key that is no key": (lambda: _message(STATE, "x"), "unknown sender"),
    "key of another run": (lambda: _message(STATE, state_key("other", AREA)), "unknown sender"),
    "key of another area": (lambda: _message(STATE, state_key(RUN, "area3")), "unknown sender"),
    "token that is none": (lambda: _entry(APPEARED, key="dsse/v3"), "key: .*dsse/v3.* is no presence token"),
    "token of another run": (lambda: _entry(APPEARED, key=live_key("b", "area", AREA, ME)), "no presence token"),
    "token with a control character": (
        lambda: _entry(APPEARED, key=live_key(RUN, "area", "a\x1b[2J", ME)),
        "no presence token",
    ),
    "token of no incarnation": (lambda: _entry(APPEARED, key=f"dsse/v3/{RUN}/live/area/{AREA}/x"), "no presence token"),
    "reason of a leave that is a novel": (
        lambda: _entry(LEFT, key=live_key(RUN, "area", AREA, ME), payload=b"x" * 10**6),
        "payload: 1,000,000 bytes",
    ),
    "note of a name without end": (lambda: _entry(NOTE, key="x" * 10_000), "key: the event has a name"),
    "payload that is cut": (lambda: _entry(payload=encode(STATE)[:-9]), "damaged: the checksum"),
    "payload with a flipped bit": (lambda: _entry(payload=_flipped(encode(STATE))), "damaged: the checksum"),
    "payload of nothing": (lambda: _entry(payload=b""), "damaged|not MessagePack"),
    "payload nested deeply": (lambda: _entry(payload=seal(_nested(100_000))), "malformed|not MessagePack"),
    "payload of a later version": (lambda: _place(0, 99), "wire version 99"),
    "payload of an unknown kind": (lambda: _place(1, "opinion"), "unknown kind"),
    "payload that is too large": (lambda: _entry(payload=bytes(9 * 2**20)), r"payload: 9,437,184 bytes"),
    "message of a plant": (lambda: _message(TelemetryMessage(STATE.header, AREA, (), (), (), (), ())), "other kind"),
    "command of another run": (
        lambda: _message(CommandMessage(Header("b", "x", ME, 1, 1, AT), AREA, (), (), False, False)),
        "unknown sender",
    ),
    "scan below zero": (lambda: _header(scan=-1), r"header\[3\]: Expected `int` >= 0"),
    "scan beyond limits": (lambda: _header(scan=2**60), r"header\[3\]: Expected `int` <"),
    "time of the sender beyond calendars": (lambda: _header(time=1e300), "time is beyond the year 9999"),
    "voltage that is nan": (lambda: _field("vm", [float("nan")] * _count()), r"not finite: vm\[0\]"),
    "voltage that is text": (lambda: _field("vm", ["1.0"] * _count()), r"vm\[0\]: Expected `float`"),
    "angle that no degrees hold": (lambda: _field("va", [1.7e308] * _count()), "va: an angle"),
    "lengths that differ": (lambda: _field("vm", [1.0]), "buses, vm, va, sigma_vm, sigma_va differ in length"),
    "bus beyond limits": (lambda: _field("buses", [10**16] * _count()), r"buses\[0\]: Expected `int` <="),
    "bus given twice": (lambda: _field("buses", [STATE.buses[0]] * _count()), "buses: one is given twice"),
    "meter given twice": (
        lambda: _message(
            dataclasses.replace(READINGS, meters=(READINGS.meters[0],) * len(READINGS.meters)), state_key(RUN, AREA)
        ),
        "meters: one is given twice",
    ),
    "name that is a novel": (lambda: _field("removed", ["x" * 301]), r"removed\[0\]: Expected `str` of length <= 300"),
    "notes without end": (lambda: _field("notes", ["x"] * 51), "notes: Expected `array` of length <= 50"),
    "table with a key twice": (lambda: _field("ages", [["area3", 1.0]] * 2), "ages: a key given twice"),
    "count that is negative": (lambda: _field("messages", -1), "messages: Expected `int` >= 0"),
}


# Rows of tables


def table_in(folder: Path, table: str) -> Path:
    (path,) = (folder / table).iterdir()
    return path


Change = Callable[[pyarrow.Table], pyarrow.Table]


def rewrite(table: str, change: Change, folder: Path) -> None:
    path = table_in(folder, table)
    changed = change(pyarrow.parquet.ParquetFile(path).read())
    pyarrow.parquet.write_table(changed, path, compression="zstd")


def _set(column: str, value: object, row: int = -1, *, as_type: Any = None) -> Change:
    """Column ``column`` with ``value`` in ``row``; cast to ``as_type`` as a whole, if that is given."""

    def change(table: pyarrow.Table) -> pyarrow.Table:
        k = table.schema.get_field_index(column)
        values = table.column(k).to_pylist()
        if as_type is not None:
            return table.set_column(k, column, pyarrow.array([value] * len(values), as_type))
        values[row] = value
        return table.set_column(k, column, pyarrow.array(values, table.schema.field(k).type))

    return change


def _drop(column: str) -> Change:
    return lambda table: table.drop_columns([column])


def _double(column: str) -> Change:
    return lambda table: table.append_column(column, table.column(column))


def _repeat_last(table: pyarrow.Table) -> pyarrow.Table:
    return pyarrow.concat_tables([table, table.slice(len(table) - 1)])


def _invalid_text(table: pyarrow.Table) -> pyarrow.Table:
    """The meter of the last row in bytes that are no UTF-8."""
    k, count = table.schema.get_field_index("meter"), len(table)
    offsets = struct.pack(f"<{count + 1}i", *range(count + 1))
    buffers = [None, pyarrow.py_buffer(offsets), pyarrow.py_buffer(b"x" * (count - 1) + b"\xff")]
    return table.set_column(k, "meter", pyarrow.Array.from_buffers(pyarrow.string(), count, buffers))


_STRUCT = pyarrow.struct([("a", pyarrow.int64())])
TABLE_KINDS: Mapping[str, tuple[str, Change, str]] = {
    "missing column": ("buses", _drop("vm_pu"), "column vm_pu is there 0 times"),
    "column given twice": ("states", _double("scan"), "column scan is there 2 times"),
    "whole numbers as text": (
        "buses",
        _set("bus", "7", as_type=pyarrow.string()),
        "column bus is of type string, not int64",
    ),
    "numbers as text": ("readings", _set("value", "7", as_type=pyarrow.string()), "column value is of type string"),
    "numbers as whole ones": ("buses", _set("vm_pu", 1, as_type=pyarrow.int64()), "column vm_pu is of type int64"),
    "times as numbers": (
        "readings",
        _set("taken_at", 1.0, as_type=pyarrow.float64()),
        "column taken_at is of type double",
    ),
    "times with a zone": (
        "states",
        _set("time", 0, as_type=pyarrow.timestamp("us", "UTC")),
        "column time is of type timestamp",
    ),
    "text as bytes": ("states", _set("quality", b"good", as_type=pyarrow.binary()), "column quality is of type binary"),
    "text as tables": ("states", _set("quality", {"a": 1}, as_type=_STRUCT), "column quality is of type struct"),
    "text as lists": (
        "states",
        _set("area", ["x"], as_type=pyarrow.list_(pyarrow.string())),
        "column area is of type list",
    ),
    "lists as text": ("states", _set("notes", "x", as_type=pyarrow.string()), "column notes is of type string"),
    "scan that is missing": ("readings", _set("scan", None), r"row \d+: scan: Expected `int`, got `null`"),
    "scan below zero": ("states", _set("scan", -3), r"row 6: scan: Expected `int` >= 0, found -3"),
    "scan beyond limits": ("buses", _set("scan", 2**60), r"row \d+: scan: Expected `int` <="),
    "time that is missing": ("states", _set("time", None), "row 6: time: Expected `float`, got `null`"),
    "time beyond calendars": (
        "readings",
        _set("taken_at", 9_000_000_000_000_000_000),
        r"row \d+: taken_at: Expected `float` <",
    ),
    "area that is missing": ("states", _set("area", None), "row 6: area: Expected `str`, got `null`"),
    "area that is a path": ("readings", _set("area", "../../etc"), r"row \d+: area: Expected `str` matching regex"),
    "area with a control character": ("states", _set("area", "area1\x1b[2J"), "row 6: area: Expected `str` matching"),
    "area with an end of line": ("states", _set("area", "area1\n"), "row 6: area: Expected `str` matching"),
    "incarnation that is none": (
        "states",
        _set("incarnation", "yesterday"),
        "row 6: incarnation: Expected `str` matching",
    ),
    "estimate below zero": ("buses", _set("estimate", -1), r"row \d+: estimate: Expected `int` >= 0"),
    "truth that is missing": ("states", _set("estimated", None), "row 6: estimated: Expected `bool`"),
    "quality that is a novel": (
        "states",
        _set("quality", "x" * 301),
        "row 6: quality: Expected `str` of length <= 300",
    ),
    "notes without end": ("states", _set("notes", ["x"] * 51), "row 6: notes: Expected `array` of length <= 50"),
    "note that is a novel": ("states", _set("notes", ["x" * 1001]), r"row 6: notes: Expected `str` of length <= 1000"),
    "notes that are missing": ("states", _set("notes", None), "row 6: notes: Expected `array`, got `null`"),
    "meter removed that is none": ("states", _set("removed", [None]), "row 6: removed: Expected `str`, got `null`"),
    "objective that is nan": ("states", _set("objective", float("nan")), "row 6: objective: Expected `float`"),
    "count below zero": ("states", _set("messages", -1), "row 6: messages: Expected `int` >= 0"),
    "split that is none": ("states", _set("split", "yesterday"), "row 6: split: Expected `str` matching"),
    "JSON that is none": ("states", _set("rejected", "{"), "row 6: rejected: Expecting property name"),
    "JSON nested deeply": ("states", _set("faults", "[" * 100_000), "row 6: faults: it nests too deeply"),
    "JSON with a key twice": ("states", _set("ages_s", '{"a": 1, "a": 2}'), "row 6: ages_s: key 'a' is given twice"),
    "JSON that is a list": ("states", _set("scans", "[1]"), "row 6: scans: Expected `object`, got `array`"),
    "JSON with nan": ("states", _set("clock_skews_s", '{"a": NaN}'), r"row 6: clock_skews_s: Expected `float`"),
    "JSON with a huge count": ("states", _set("rejected", '{"a": 1e300}'), "row 6: rejected: "),
    "bus beyond limits": ("buses", _set("bus", 10**16), r"row \d+: bus: Expected `int` <="),
    "bus given twice": ("buses", _repeat_last, r"row \d+: bus: \d+ stands twice in one message"),
    "voltage that is missing": ("buses", _set("vm_pu", None), r"row \d+: vm_pu: Expected `float`, got `null`"),
    "voltage that is nan": ("buses", _set("vm_pu", float("nan")), r"row \d+: vm_pu: Expected `float`"),
    "sigma that is infinite": ("buses", _set("sigma_vm_pu", float("inf")), r"row \d+: sigma_vm_pu: Expected `float`"),
    "reading that is missing": ("readings", _set("value", None), r"row \d+: value: missing of meter"),
    "reading that is infinite": ("readings", _set("value", float("-inf")), r"row \d+: value: Expected `float`"),
    "reading without a meter": ("readings", _set("meter", None), r"row \d+: value: .* stands without a meter"),
    "meter that is a novel": ("readings", _set("meter", "x" * 301), r"row \d+: meter: Expected `str` of length <= 300"),
    "meter given twice": ("readings", _repeat_last, r"row \d+: meter: .* stands twice in one message"),
    "meter that is no text": ("readings", _invalid_text, "codec can't decode|UTF-?8"),
    "residual without an estimate": (
        "readings",
        _set("normalised_residual", 1.0),
        r"row \d+: normalised_residual: .* go together",
    ),
    "event without a name": ("events", _set("event", None), r"row \d+: event: Expected `str`, got `null`"),
    "event beyond calendars": ("events", _set("time", -(9 * 10**18)), r"row \d+: time: Expected `float` >="),
}


HOSTILE_KINDS: Mapping[str, tuple[str, Change]] = {
    "reading": ("readings", _set("value", -1.7e308)),
    "sigma": ("readings", _set("sigma", 1e308)),
    "sigma of nothing": ("readings", _set("sigma", 0.0)),
    "estimate": ("readings", _set("estimate", 1.7e308, 0)),
    "residual": ("readings", _set("normalised_residual", -1.7e308, 0)),
    "unknown meter": ("readings", _set("meter", "\x1b[2J")),
    "voltage": ("buses", _set("vm_pu", 1.7e308)),
    "angle": ("buses", _set("va_deg", -1.7e308)),
    "unknown bus": ("buses", _set("bus", -(10**15))),
    "quality": ("states", _set("quality", "splendid\x1b[2J")),
    "age": ("states", _set("telemetry_age_s", -1e308)),
    "objective": ("states", _set("objective", -1e308)),
    "message at the end of time": ("states", _set("time", 253_402_300_799_000_000)),
    "message before all others": ("states", _set("time", -62_135_596_800_000_000)),
}
"""Kinds that are well formed, and nothing that an honest area says."""


# Whole files


def _replace(where: str, content: bytes, folder: Path) -> None:
    path = table_in(folder, where)
    path.write_bytes(content)


def _cut(where: str, folder: Path) -> None:
    path = table_in(folder, where)
    path.write_bytes(path.read_bytes()[:-40])


def _flip(where: str, folder: Path) -> None:
    path = table_in(folder, where)
    content = bytearray(path.read_bytes())
    content[20:60] = bytes(40)
    path.write_bytes(content)


def _in_place(where: str, make: Callable[[Path], object], folder: Path) -> None:
    path = table_in(folder, where)
    path.unlink()
    make(path)


def _make_folder(path: Path) -> None:
    path.mkdir()


def _link_to_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _link_to_itself(path: Path) -> None:
    path.symlink_to(path)


FILE_KINDS: Mapping[str, tuple[bool, Callable[[Path], None], str]] = {
    "log that is none": (False, partial(_replace, "log", b"time,bus,vm\n"), "is no log of a recording"),
    "log that is a pipe": (False, partial(_in_place, "log", os.mkfifo), "is a pipe or a device"),
    "log that is a device": (False, partial(_in_place, "log", _link_to_device), "is a pipe or a device"),
    "log that is a folder": (False, partial(_in_place, "log", _make_folder), "is a folder"),
    "table that is none": (True, partial(_replace, "readings", b"PAR1 not at all"), "is no table of a recording"),
    "table of nothing": (True, partial(_replace, "readings", b""), "is no table of a recording"),
    "table that is cut": (True, partial(_cut, "states"), "is no table of a recording"),
    "table with a damaged page": (True, partial(_flip, "buses"), "is no table of a recording"),
    "table that is a pipe": (True, partial(_in_place, "states", os.mkfifo), "is a pipe or a device"),
    "table that is a device": (True, partial(_in_place, "buses", _link_to_device), "is a pipe or a device"),
    "table that is a folder": (True, partial(_in_place, "readings", _make_folder), "is a folder"),
    "table of another table": (
        True,
        lambda folder: shutil.copy(table_in(folder, "events"), table_in(folder, "states")) and None,
        "column .* is there 0 times",
    ),
}


def _about(**changes: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "recording.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes), encoding="utf-8")

    return change


def _about_text(text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "recording.json").write_text(text) and None


def _pipe(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


REFUSED_KINDS: Mapping[str, tuple[Callable[[Path], None], str]] = {
    "not JSON": (_about_text("{"), "does not say of which run"),
    "a list": (_about_text("[]"), "does not say of which run"),
    "nested deeply": (_about_text("[" * 100_000), "does not say of which run"),
    "a key twice": (_about_text('{"format": 1, "format": 1}'), "does not say of which run"),
    "another format": (_about(format=2), "has format 2; this version reads 1"),
    "run of a number": (_about(run=7), r"Expected `str`, got `int` - at `\$.run`"),
    "run that is a path": (_about(run="../x"), r"at `\$.run`"),
    "areas of one text": (_about(areas="area1"), r"Expected `array`, got `str` - at `\$.areas`"),
    "area that is a path": (_about(areas=["../../x"]), r"at `\$.areas\[0\]`"),
    "a pipe": (_pipe("recording.json"), "is a pipe or a device"),
}


# Small files that expand to gigabytes

ROWS = 6_000_000
LARGE = 2**27  # characters


def _schema(path: Path) -> pyarrow.Schema:
    return pyarrow.parquet.read_schema(path).remove_metadata()


def _write_many_rows(path: Path) -> None:
    """Millions of rows, all alike."""
    one = pyarrow.parquet.ParquetFile(path).read().slice(0, 1)
    many = pyarrow.table(
        {name: pyarrow.repeat(one.column(name)[0], ROWS // 6) for name in one.column_names}, one.schema
    )
    with pyarrow.parquet.ParquetWriter(path, many.schema, compression="zstd") as writer:
        for _ in range(6):
            writer.write_table(many, row_group_size=len(many))


def _write_long_texts(path: Path) -> None:
    """50,000 rows of one text of 60,000 characters, which stands in the file once: 3 GB."""
    good, count = pyarrow.parquet.ParquetFile(path).read(), 50_000
    columns = {name: pyarrow.repeat(good.column(name)[0], count) for name in good.column_names}
    columns["quality"] = pyarrow.DictionaryArray.from_arrays(pyarrow.repeat(0, count).cast("int32"), ["x" * 60_000])
    pyarrow.parquet.write_table(pyarrow.table(columns), path, compression="zstd", store_schema=False)


def _write_long_lists(path: Path) -> None:
    """The same in lists."""
    good, count = pyarrow.parquet.ParquetFile(path).read(), 50_000
    columns = {name: pyarrow.repeat(good.column(name)[0], count) for name in good.column_names}
    words = pyarrow.DictionaryArray.from_arrays(pyarrow.repeat(0, count).cast("int32"), ["x" * 60_000])
    columns["notes"] = pyarrow.ListArray.from_arrays(pyarrow.array(range(count + 1), pyarrow.int32()), words)
    pyarrow.parquet.write_table(pyarrow.table(columns), path, compression="zstd", store_schema=False)


def _write_large_page(path: Path) -> None:
    """A text without end of blanks, of which the list of contents says that it is short."""
    one = pyarrow.parquet.ParquetFile(path).read().slice(0, 1)
    k = one.schema.get_field_index("details")
    blown = one.set_column(k, "details", pyarrow.array([" " * LARGE]))
    pyarrow.parquet.write_table(blown, path, compression="zstd", use_dictionary=False)
    content, group = path.read_bytes(), pyarrow.parquet.read_metadata(path).row_group(0)
    at = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    footer = content[at:]
    for size in (group.total_byte_size, *(group.column(j).total_uncompressed_size for j in range(group.num_columns))):
        stated = _varint(2 * size)
        if size > LARGE:
            footer = footer.replace(stated, b"\x90" + b"\x80" * (len(stated) - 2) + b"\x00")  # 8 in as many bytes
    path.write_bytes(content[:at] + footer)
    assert pyarrow.parquet.read_metadata(path).row_group(0).total_byte_size == 8


def _varint(number: int) -> bytes:
    """As Thrift's compact protocol has an integer: groups of seven bits."""
    return bytes([number]) if number < 128 else bytes([number & 127 | 128]) + _varint(number >> 7)


BOMBS: Mapping[str, tuple[str, Callable[[Path], None], str]] = {
    "rows": ("buses", _write_many_rows, "has 6,000,000 rows, the limit is 5,000,000"),
    "texts": ("states", _write_long_texts, "row 1: quality: Expected `str` of length <= 300"),
    "lists of texts": ("states", _write_long_lists, "row 1: notes: Expected `str` of length <= 1000"),
    "a page": ("events", _write_large_page, "row group 1 has more than 67,108,864 bytes when it is unpacked"),
}
