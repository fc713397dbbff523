"""Words of OpenDSS: verbs, options, classes, properties, and which of them are handed over to it, of a TOML file."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dsse_core.files.bounded_parsing import parse_toml

Mark = Literal["handed over", "left out", "refused"]
MARKS: dict[str, Mark] = {"-": "left out", "!": "refused"}


@dataclass(frozen=True)
class Words:
    """Words in the order of OpenDSS, in lower case, each with its mark."""

    order: Sequence[str]
    marks: Mapping[str, Mark]

    @classmethod
    def of(cls, text: str) -> Words:
        marks: dict[str, Mark] = {}
        for word in text.split():
            mark = MARKS.get(word[0], "handed over") if len(word) > 1 else "handed over"
            marks[word if mark == "handed over" else word[1:]] = mark
        return cls(list(marks), marks)

    def find(self, given: str) -> str | None:
        """The word that OpenDSS takes ``given`` for: itself, else the first one that it begins; None without one."""
        if not given:
            return None
        given = given.lower()
        return given if given in self.marks else next((word for word in self.order if word.startswith(given)), None)


@dataclass(frozen=True)
class Vocabulary:
    """``left_out``: classes that change no power flow. ``classes``: of each that is handed over, the properties."""

    verbs: Words
    options: Words
    left_out: frozenset[str]
    classes: Mapping[str, Words]


@functools.cache
def load_vocabulary() -> Vocabulary:
    content = parse_toml((Path(__file__).parent / "vocabulary.toml").read_text(encoding="utf-8"))
    return Vocabulary(
        Words.of(content["verbs"]),
        Words.of(content["options"]),
        frozenset(content["left_out"].split()),
        {name: Words.of(text) for name, text in content["classes"].items()},
    )
