"""All commands alike: their help, their exit codes, and their places in ``dsse --help``."""

from __future__ import annotations

import click
import pytest

from coordinator.cli.command import PARTS, Command, list_leaves
from coordinator.cli.main import commands

LEAVES = list(list_leaves(commands))
ALL_COMMANDS = pytest.mark.parametrize(("words", "command"), LEAVES, ids=[" ".join(words) for words, _ in LEAVES])
ITS_OWN_HELP = "agent"  # passes its arguments on to a parser that starts faster


def test_help_lists_every_command_in_one_of_four_parts(dsse):
    code, out, _ = dsse("--help")
    assert code == 0
    sections = dict(zip(PARTS, out.split("\n\n")[-len(PARTS) :], strict=True))
    for part, section in sections.items():
        assert section.startswith(f"{part} ")
    for name, command in commands.commands.items():
        assert f"\n  {name} " in sections[command.part]  # type: ignore[attr-defined]
    assert "..." not in "".join(sections.values()), "a line is cut short"


@ALL_COMMANDS
def test_a_command_explains_itself_with_an_example_and_its_exit_codes(dsse, words: tuple[str, ...], command):
    if words[0] == ITS_OWN_HELP:
        assert "Example:" in (command.help or "")
        return
    code, out, _ = dsse(*words, "--help")
    assert code == 0
    assert f"dsse {' '.join(words)}" in out.split("Example")[-1]
    if isinstance(command, Command):
        listed = out.split("Exit codes:")[-1].split("\n")
        assert [int(line.split()[0]) for line in listed if line[:3].strip()] == list(command.codes)


@ALL_COMMANDS
def test_an_option_has_one_meaning_in_all_commands(words: tuple[str, ...], command: click.Command):
    options = {o for p in command.params if isinstance(p, click.Option) and not p.hidden for o in p.opts}
    assert not options & {"--scenario", "--grid"}, "a scenario is an argument"
    assert not {"--timeout", "--wait"} <= options
    assert ("--timeout" in options) == (words[0] in ("run", "simulate", "compare", "sweep"))
