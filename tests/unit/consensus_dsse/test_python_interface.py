"""``import consensus_dsse``: quick, with examples that run, short reprs, and packages that are ours."""

from __future__ import annotations

import doctest
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib.machinery import PathFinder
from pathlib import Path

import pytest

import consensus_dsse
from consensus_dsse.own_packages import PACKAGES, ForeignPackageError, check_own_packages
from coordinator.cli.main import run_command
from dsse_core.files import installation
from dsse_core.grid.columns import Records

ROOT = Path(__file__).parents[3]
MODULES = [
    *("consensus_dsse.grids", "consensus_dsse.centralised", "consensus_dsse.studies"),
    "coordinator",
    *("dsse_core.estimation.batch", "dsse_core.estimation.plan"),
]


def python(code: str, folder: Path, *first: Path) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join(map(str, [*first, ROOT]))
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_docstrings_are_true(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0


def test_the_examples_of_the_page_are_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    result = doctest.testfile(str(ROOT / "docs/reference/python.md"), module_relative=False)
    assert result.attempted > 0
    assert result.failed == 0


def test_every_name_is_there_and_documented() -> None:
    assert dir(consensus_dsse) == sorted(consensus_dsse.__all__)
    for name in consensus_dsse.__all__:
        found = getattr(consensus_dsse, name)
        assert found.__doc__
        assert not callable(found) or isinstance(found, type) or ">>>" in found.__doc__, name
    with pytest.raises(AttributeError, match="power_flow"):
        consensus_dsse.powerflow  # noqa: B018


def test_the_import_loads_nothing_that_is_not_used(tmp_path: Path) -> None:
    code = "import sys; before = set(sys.modules); import consensus_dsse; print(*sorted(set(sys.modules) - before))"
    assert set(python(code, tmp_path).stdout.split()) <= {"__future__", "consensus_dsse"}


def test_no_result_fills_the_screen(tmp_path: Path) -> None:
    result = consensus_dsse.simulate("ieee33", out=tmp_path / "run", plots=False)
    for shown in (result, result.scenario, consensus_dsse.estimate("ieee33")):
        assert len(repr(shown)) < 500
    for table in (result.buses, result.branches, result.meters, result.areas):
        assert len(repr(table).splitlines()) < 10
    assert len(result.buses) == 33
    assert result.areas.area == ("area1", "area2", "area3")


def reachable(shown: object, seen: dict[int, object]) -> Iterator[object]:
    """Dataclasses that attributes lead to, two of every list."""
    if id(shown) in seen:
        return
    seen[id(shown)] = shown
    if is_dataclass(shown):
        yield shown
        inside = [getattr(shown, field.name) for field in fields(shown)]
    elif isinstance(shown, dict):
        inside = list(shown.values())[:2]
    else:
        inside = list(shown[:2]) if isinstance(shown, tuple | list | Records) else []
    for part in inside:
        yield from reachable(part, seen)


@pytest.mark.slow
@pytest.mark.parametrize("n", [33, 600])
def test_nothing_that_a_result_leads_to_fills_the_screen(n: int, tmp_path: Path) -> None:
    scenario: str | Path = "ieee33"
    if n > 33:
        assert run_command(["generate", "--buses", str(n), "--out", str(tmp_path / "grid")]) == 0
        scenario = next((tmp_path / "grid").glob("scenario.toml"))
    found = consensus_dsse.estimate(scenario), consensus_dsse.power_flow(scenario)
    seen: dict[int, object] = {}
    result = consensus_dsse.simulate(scenario, out=tmp_path / "run", plots=False)
    shown = [x for one in (*found, result) for x in reachable(one, seen)]
    shown += [one.tables for one in (*found, result)]
    assert {"Network", "Partition", "EstimationResult", "BadDataReport"} <= {type(one).__name__ for one in shown}
    long = {type(one).__name__: len(repr(one)) for one in shown if len(repr(one)) > 500}
    assert long == {}


def test_a_network_of_ones_own_has_flows_without_a_scenario(tmp_path: Path) -> None:
    text = (ROOT / "scenarios/cases/case33bw.toml").read_text(encoding="utf-8")
    (tmp_path / "network.toml").write_text(text, encoding="utf-8")
    of_scenario = consensus_dsse.power_flow("case33bw")
    for given in (tmp_path / "network.toml", consensus_dsse.load_network(tmp_path / "network.toml")):
        solved = consensus_dsse.power_flow(given)
        assert solved.branches.i_from_a.tolist() == of_scenario.branches.i_from_a.tolist()
        assert "case33bw" in repr(solved)
        with pytest.raises(consensus_dsse.InvalidInputError):
            consensus_dsse.power_flow(given, changes={"seed": 3})


def test_a_network_that_is_not_shipped_is_answered_with_how_to_name_a_file() -> None:
    with pytest.raises(consensus_dsse.InvalidInputError, match=r"shipped: case33bw.*file of your own ends in \.toml"):
        consensus_dsse.load_network("feeder")


def test_our_packages_are_ours() -> None:
    check_own_packages()


@pytest.mark.parametrize("name", PACKAGES)
@pytest.mark.parametrize("installed", [False, True])
def test_a_package_of_the_same_name_is_named_with_the_cure(name: str, installed: bool, tmp_path: Path) -> None:
    other = tmp_path / "other"
    (other / name).mkdir(parents=True)
    (other / name / "__init__.py").write_text("", encoding="utf-8")
    if installed:
        (other / "foreign-1.0.dist-info").mkdir()
        (other / "foreign-1.0.dist-info" / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n"
        )
        (other / "foreign-1.0.dist-info" / "top_level.txt").write_text(f"{name}\n")
    cure = "pip uninstall foreign" if installed else "rename it"
    for code in (
        "import consensus_dsse; consensus_dsse.run",
        "import sys, consensus_dsse.__main__ as m; sys.exit(m.main())",
    ):
        ended = python(code, tmp_path, other)
        assert ended.returncode != 0
        assert str(other / name / "__init__.py") in ended.stderr
        assert cure in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(("missing", "origin"), [("agents", installation.install_command()), ("dsse_core", "")])
def test_a_package_that_is_missing_is_named_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, missing: str, origin: str
) -> None:
    find = PathFinder.find_spec
    monkeypatch.setattr(PathFinder, "find_spec", lambda name: None if name == missing else find(name))
    with pytest.raises(
        ForeignPackageError, match=f"package '{missing}' is missing.*--force-reinstall --no-deps"
    ) as error:
        check_own_packages()
    assert origin.split(" install ")[-1] in str(error.value)
