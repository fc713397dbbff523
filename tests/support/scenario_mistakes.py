"""A good scenario file, and what is wrong with one that has been changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import load_scenario

GOOD = find_shipped("shipped")["ieee33"].read_text(encoding="utf-8")


def problems_of(tmp_path: Path, text: str) -> tuple[str, ...]:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError) as caught:
        load_scenario(path, strategies=("angle-offset", "information"))
    assert str(path) in caught.value.what
    return caught.value.problems


def the_only(problems: tuple[str, ...]) -> str:
    assert len(problems) == 1, problems
    return problems[0]


def link(sender: str, receiver: str) -> str:
    return f'\n[[faults.link]]\nfrom = "{sender}"\nto = "{receiver}"\nloss = 0.5\n'
