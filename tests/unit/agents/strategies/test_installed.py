"""Strategies are found by entry points; what is wrong with one is a single error that names its distribution."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from agents.messages.packing import MESSAGE_TYPES
from agents.strategies import installed
from agents.strategies.angle_offset import AngleOffset
from agents.strategies.installed import list_strategies, load_strategy
from coordinator.cli.main import run_command
from dsse_core.errors import InvalidInputError
from tests.support.foreign_distribution import write_distribution

ROOT = Path(__file__).parents[4]
SHIPPED = ("admm", "angle-offset", "information")
CLASS = """
from dataclasses import dataclass
from typing import ClassVar
from agents.strategies import BoundaryUpdate, Number, Strategy

@dataclass(frozen=True, slots=True)
class Note(BoundaryUpdate):
    kind: ClassVar[str] = "KIND"
    text: TYPE

class Gossip(Strategy):
    message_types = (Note,)
    def __init__(self, content): ...
    def solve(self, known): return None, ()
    def message_for(self, neighbour, estimate, header): return Note(header, neighbour.bus, 0.0)
    def is_update(self, neighbour, message, last): return False
"""


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str, entry: str = "gossip = {module}:Gossip") -> None:
    """A distribution whose module of a new name has ``text``."""
    module = f"gossip_{abs(hash(str(folder)))}"
    write_distribution(folder, "talkative", entry.format(module=module), {module: text})
    monkeypatch.syspath_prepend(str(folder))


def of_kind(kind: str, field: str = "Number") -> str:
    return CLASS.replace("KIND", kind).replace("TYPE", field)


def test_the_shipped_strategies_are_entry_points_like_all_others():
    assert list_strategies() == SHIPPED
    assert load_strategy("angle-offset") is AngleOffset


def test_no_program_text_tests_for_the_name_of_a_strategy():
    compared = re.compile(rf"""(==|!=|\bin\b|\bcase)\s*\(?["']({"|".join(SHIPPED)})["']""")
    files = [
        path for room in ("agents", "coordinator", "dsse_core", "scenarios") for path in (ROOT / room).rglob("*.py")
    ]
    assert len(files) > 200
    assert [path.name for path in files if compared.search(path.read_text())] == []


def test_a_strategy_of_ones_own_is_listed_and_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(tmp_path, monkeypatch, of_kind("gossip-1"))
    assert list_strategies() == ("admm", "angle-offset", "gossip", "information")
    assert load_strategy("gossip").kinds() == ("gossip-1",)
    assert "gossip-1" in MESSAGE_TYPES


def test_an_unknown_strategy_is_answered_with_those_that_are_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    install(tmp_path, monkeypatch, of_kind("gossip-2"))
    assert run_command(["simulate", "ieee33", "--strategy", "gosip"]) == 2
    error = capsys.readouterr().err
    assert "unknown strategy 'gosip'; allowed: admm, angle-offset, gossip, information" in error
    assert "did you mean 'gossip'" in error


@pytest.mark.parametrize(
    ("text", "entry", "message"),
    [
        ("import nowhere_at_all", "gossip = {module}:Gossip", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("def f(:", "gossip = {module}:Gossip", "SyntaxError"),
        ("1 / 0", "gossip = {module}:Gossip", "ZeroDivisionError"),
        ("", "gossip = {module}:Gossip", "has no attribute 'Gossip'"),
        ("Gossip = 5", "gossip = {module}:Gossip", "is no class derived from agents.strategies.Strategy"),
        (of_kind("gossip-3").replace("def solve", "def sovle"), "gossip = {module}:Gossip", "does not define solve"),
        (of_kind("gossip-4").replace("(Note,)", "()"), "gossip = {module}:Gossip", "message_types is missing"),
        (of_kind("load"), "gossip = {module}:Gossip", "kind 'load' is that of agents.messages.types.LoadMessage"),
        (of_kind("Gossip!"), "gossip = {module}:Gossip", "kind is 'Gossip!'; it must be of a-z, 0-9, _ and -"),
        (of_kind("gossip-5", "range"), "gossip = {module}:Gossip", "field text has the type"),
    ],
    ids=["import", "syntax", "crash", "attribute", "no class", "method", "messages", "taken", "kind", "field"],
)
def test_a_broken_strategy_is_one_error_that_names_its_distribution(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    text: str,
    entry: str,
    message: str,
):
    install(tmp_path, monkeypatch, text, entry)
    assert run_command(["simulate", "ieee33", "--strategy", "gossip", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "strategy 'gossip' of distribution talkative 0.1.0" in error
    assert "Traceback" not in error
    assert (
        run_command(["simulate", "ieee33", "--no-plots", "--out", str(tmp_path / "other")]) == 0
    )  # it disturbs no other


def test_a_name_that_two_distributions_give_is_rejected_with_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(tmp_path, monkeypatch, of_kind("gossip-6"), "admm = {module}:Gossip")
    with pytest.raises(InvalidInputError, match=r"consensus-dsse .* and distribution talkative 0\.1\.0; uninstall"):
        load_strategy("admm")


def test_a_checkout_that_is_older_than_its_strategies_says_what_to_do(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(installed, "_find_entries", lambda path: ())
    with pytest.raises(InvalidInputError, match=r"install consensus-dsse again: .* pip install"):
        list_strategies()


def test_no_agent_reads_what_the_distribution_of_a_sound_strategy_says_of_itself(monkeypatch: pytest.MonkeyPatch):
    asked: list[object] = []
    monkeypatch.setattr(installed, "_owner_of", lambda entry: asked.append(entry) or "")
    installed._load.cache_clear()
    load_strategy("information")
    assert asked == []
