"""Digests of configurations. They reveal a configuration that was edited since its split, or is of another split.

The digest of a configuration covers all keys on which the areas' joint estimate rests: the area's network in p.u., its
meters, its neighbours and boundary buses, the way to the hub, the reference, the strategy with its settings, the rules
of readings and the limits of quality. ``LEFT_OUT`` lists the other keys, which concern the process, injected faults,
the start of the iteration, or names. Keys enter in alphabetical order and numbers as their 8 bytes, so that the digest
is the same on any machine and in any format of the file. The digest of a split covers those of all its files, and the
rule of the meters' standard deviations.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dsse_core.split_identity import DIGITS

LEFT_OUT = frozenset(
    {
        *("format", "split", "run", "endpoints", "listen", "beat_s", "seed", "clock_error_s"),
        *("load_messages.p_error", "load_messages.q_error", "neighbour.faults"),  # injected faults
        *("exchange.entry_vm", "exchange.entry_va", "exchange.no_load"),  # where the iteration begins
        *("network.bus.name", "network.branch.name"),
    }
)


def digest_configuration(values: Mapping[str, Any]) -> str:
    """Returns the digest of a configuration, 16 hex digits; ``values``: key -> value, see ``LEFT_OUT``."""
    return _digest(_list_places("", dict(values)))


def digest_split(contents: Mapping[str, str], sigmas: Mapping[str, Any]) -> str:
    """Returns the digest of a split, 16 hex digits.

    ``contents``: area -> digest of its configuration. ``sigmas``: the rule of the meters' standard deviations.
    """
    return _digest([*_list_places("sigmas", dict(sigmas)), *_list_places("files", dict(contents))])


def _digest(places: Iterator[bytes] | Sequence[bytes]) -> str:
    digest = hashlib.sha256()
    for place in places:
        digest.update(len(place).to_bytes(8, "little"))
        digest.update(place)
    return digest.hexdigest()[:DIGITS]


def _list_places(key: str, value: Any) -> Iterator[bytes]:
    """Yields the bytes that stand for ``value`` at ``key`` of a file; nothing for a key of ``LEFT_OUT``."""
    if key in LEFT_OUT:
        return
    match value.item() if isinstance(value, np.generic) else value:
        case dict():
            for part in sorted(value, key=str):
                yield from _list_places(f"{key}.{part}" if key else str(part), value[part])
        case list() | tuple():
            yield from (f"{key}[{len(value)}]".encode(), *_list_items(key, value))
        case plain:
            yield from (key.encode(), _pack(plain))


def _list_items(key: str, items: Sequence[Any]) -> Iterator[bytes]:
    kinds = set(map(type, items))
    if kinds <= {int, float}:
        yield (np.array(items, dtype="<f8") + 0.0).tobytes()  # of -0.0 makes 0.0
    elif kinds == {str}:
        yield b"".join(map(_pack, items))
    else:
        for item in items:
            yield from _list_places(key, item)


def _pack(value: Any) -> bytes:
    """Returns the bytes of a value with its type. A whole number and the same float are equal, as they are in files."""
    match value:
        case None:
            return b"-"
        case bool():
            return b"b\x01" if value else b"b\x00"
        case int() | float():
            return b"f" + struct.pack("<d", float(value) + 0.0)
        case _:
            text = str(value).encode()
            return b"t" + len(text).to_bytes(4, "little") + text
