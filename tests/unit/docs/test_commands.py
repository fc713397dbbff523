"""Every command line that README and docs print can be parsed by ``dsse``, and the scenarios that they name exist."""

from __future__ import annotations

import re
from importlib.util import find_spec

import click
import pytest

from agents.__main__ import make_parser
from coordinator.cli.main import commands
from scenarios.files.shipped_files import find_shipped
from tests.support.pages import PAGES, ROOT, find_commands, name_of

SHIPPED_SCENARIOS = set(find_shipped("shipped"))
PLACEHOLDER = re.compile(r"\[?[A-Z_|]+\]?|\.\.\.|\S*\|\S*")
COMMANDS = sorted({(name_of(page), tuple(words)) for page in PAGES for words in find_commands(page)})


def find_mistake(words: tuple[str, ...]) -> str | None:
    """What ``dsse`` rejects of a command line; a placeholder such as NAME stands for any value."""
    try:
        if words[0] == "agent":
            if len(words) > 1:
                make_parser().parse_args(list(words[1:]))
            return None
        return find_mistake_of(commands, words)
    except click.UsageError as error:
        return error.format_message()
    except SystemExit:
        return "the agent's parser rejects it"


def find_mistake_of(group: click.Group, words: tuple[str, ...]) -> str | None:
    if words[0].startswith("-"):
        group.make_context("dsse", list(words), resilient_parsing=True)
        return None
    command = group.get_command(click.Context(group), words[0])
    if command is None and not PLACEHOLDER.fullmatch(words[0]):
        return f"there is no command {words[0]!r}"
    if command is None or len(words) == 1:
        return None
    if isinstance(command, click.Group):
        return find_mistake_of(command, words[1:])
    return find_mistake_of_options(command, words[1:])


def find_mistake_of_options(command: click.Command, words: tuple[str, ...]) -> str | None:
    options = command.make_parser(click.Context(command))
    values, left, _ = options.parse_args(args=list(words))
    given = {name: value for name, value in values.items() if value is not None}
    for parameter in command.params:
        value = given.get(parameter.name or "")
        if value is None or PLACEHOLDER.fullmatch(str(value)) or isinstance(parameter.type, click.Path):
            continue
        with click.Context(command) as context:
            parameter.type_cast_value(context, value)
    scenario = given.get("scenario")
    if isinstance(scenario, str) and not PLACEHOLDER.fullmatch(scenario) and "/" not in scenario:
        return None if scenario in SHIPPED_SCENARIOS else f"there is no shipped scenario {scenario!r}"
    return f"nothing takes {left}" if left else None


def test_there_are_commands_to_try():
    assert len(COMMANDS) > 60
    assert ("docs/tutorials/first-run.md", ("run", "ieee33-lossy")) in COMMANDS


@pytest.mark.parametrize(
    ("page", "words"), COMMANDS, ids=lambda value: value if isinstance(value, str) else " ".join(value)
)
def test_a_command_of_a_page_is_understood(page: str, words: tuple[str, ...]):
    assert find_mistake(words) is None


@pytest.mark.parametrize(
    "words",
    [
        ("fly",),
        ("run", "ieee34"),
        ("run", "ieee33", "--sede", "1"),
        ("plant", "ieee33", "--every", "x"),
        ("agent", "a", "--at"),
    ],
    ids=" ".join,
)
def test_a_command_that_the_program_rejects_is_found(words: tuple[str, ...]):
    assert find_mistake(words) is not None


def test_pages_name_only_modules_targets_and_tests_that_exist():
    text = "\n".join(page.read_text() for page in PAGES)
    modules = set(re.findall(r"python3? -m (benchmarks[.\w]*)", text))
    targets = set(re.findall(r"(?:`|^    )make ([\w-]+)", text, re.MULTILINE))
    tests = set(re.findall(r"\btests/[\w/]+\.py\b", text)) | {
        page for page in re.findall(r"pytest (tests/[\w/]+)", text)
    }
    assert min(len(modules), len(targets), len(tests)) > 2
    assert [module for module in modules if find_spec(module) is None] == []
    assert targets - set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)) == set()
    assert [test for test in tests if not (ROOT / test).exists() and not (ROOT / f"{test}.py").exists()] == []


def test_pages_name_only_scenarios_that_are_shipped():
    prefixes = "|".join({name.split("-")[0] for name in SHIPPED_SCENARIOS})
    named = {name for page in PAGES for name in re.findall(rf"`((?:{prefixes})(?:-[a-z]+)*)`", page.read_text())}
    assert named - SHIPPED_SCENARIOS == set()
