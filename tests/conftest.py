"""Options of the test run."""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings

from scenarios.files.shipped_files import find_shipped

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line has it; before anything loads numpy
# Containers often keep Python from keeping bytecode: hundreds of processes would compile all modules of ours anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

UNITS = Path(__file__).parent / "unit"
# Loading pandapower takes 9 s; all tests of these modules are long, or run processes.
LOAD_PANDAPOWER = {
    "test_against_pandapower.py",
    "test_import.py",
    "test_import_measured_loads.py",
    "test_import_pandapower.py",
    "test_results_against_pandapower.py",
}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="the tests and random cases that a plain run leaves out")
    parser.addoption("--thorough", action="store_true", help="all tests, on as many cases as the documents claim")


def pytest_configure(config: pytest.Config) -> None:
    """Properties without a number of examples of their own are those that the documentation gives a number for."""
    settings.register_profile(
        "documented",
        max_examples=300 if config.getoption("--thorough") else 8,
        deadline=None,
        phases=[Phase.explicit, Phase.generate],  # examples are grids of given sizes: shrinking them takes an hour
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )
    settings.load_profile("documented")
    if config.option.markexpr == "quick":  # after each change of dsse_core, compiling would take half a minute
        os.environ.setdefault("NUMBA_DISABLE_JIT", "1")
    elif (
        config.getoption("numprocesses", None)
        and not config.option.collectonly
        and find_spec("numba")
        and config.args_source is not pytest.Config.ArgsSource.ARGS  # a few named tests compile what they need
    ):
        compile_ahead(config)


def compile_ahead(config: pytest.Config) -> None:
    """Beside the first tests, once for all workers: each of them would compile the same."""
    command = [sys.executable, "-P", "-m", "coordinator", "compile"]
    environment = {**os.environ, "PYTHONPATH": str(config.rootpath)}
    silent = subprocess.DEVNULL
    compiling = subprocess.Popen(command, env=environment, start_new_session=True, stdout=silent, stderr=silent)

    def end() -> None:
        compiling.kill()
        compiling.wait()

    config.add_cleanup(end)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """``random_seed`` of one random case, and ``n_cases`` of a collection that is one test.

    The markers say how many: ``few`` in a plain run, ``long`` with those of ``--long``, ``many`` with ``--thorough``.
    """
    marker = metafunc.definition.get_closest_marker("random_cases")
    if marker is not None:
        few, more = marker.kwargs["few"], marker.kwargs["long"]
        seeds: list[object] = [*range(few), *(pytest.param(k, marks=pytest.mark.long) for k in range(few, more))]
        if metafunc.config.getoption("--thorough"):
            seeds = [*range(marker.kwargs["many"])]
        metafunc.parametrize("random_seed", seeds)
    marker = metafunc.definition.get_closest_marker("n_cases")
    if marker is not None:
        few, more, many = (marker.kwargs[name] for name in ("few", "long", "many"))
        longer = [pytest.param(more, marks=pytest.mark.long)] if more > few else []
        metafunc.parametrize("n_cases", [many] if metafunc.config.getoption("--thorough") else [few, *longer])


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """For the quick ones, modules that have none of them are not even imported."""
    if config.option.markexpr != "quick" or collection_path.suffix != ".py":
        return None
    if UNITS in collection_path.parents:
        return True if collection_path.name in LOAD_PANDAPOWER else None
    return None if "pytest.mark.quick" in collection_path.read_text() else True


@pytest.hookimpl(tryfirst=True)  # before ``-m`` chooses
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """``quick``: tests of units that are not ``slow``; in other folders, modules say it themselves.

    A plain run leaves out ``long`` and ``thorough`` tests; ``--long`` runs the long ones alone, ``--thorough`` all.
    """
    for item in items:
        if UNITS in item.path.parents and item.get_closest_marker("slow") is None:
            item.add_marker("quick")
    if not config.getoption("--thorough"):
        wanted = [item for item in items if level_of(item) == ("long" if config.getoption("--long") else "plain")]
        kept = set(wanted)
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = wanted


def level_of(item: pytest.Item) -> str:
    """The least of the levels that runs a test."""
    return next((level for level in ("thorough", "long") if item.get_closest_marker(level) is not None), "plain")


@pytest.fixture
def edited_scenario(tmp_path: Path) -> Callable[..., Path]:
    """A copy of a shipped scenario with some of its text replaced."""

    def edit(name: str, *replacements: tuple[str, str]) -> Path:
        text = find_shipped("shipped")[name].read_text()
        for old, new in replacements:
            assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times in {name}.toml"
            text = text.replace(old, new)
        path = tmp_path / "edited.toml"
        path.write_text(text)
        return path

    return edit
