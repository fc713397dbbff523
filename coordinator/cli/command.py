"""Commands of ``dsse`` as ``--help`` and the reference page show them: their group, and their exit codes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import click

from coordinator.watch.interrupts import INTERRUPTED_CODE

TRY, STUDY, OPERATE, INSPECT = "Try", "Study", "Operate", "Inspect"
PARTS = {
    TRY: "a scenario on this machine",
    STUDY: "networks, estimates and strategies",
    OPERATE: "a system on one host or several",
    INSPECT: "a running system, or a recording",
}
LONGEST_LINE = 200  # letters, of what a list of commands says of one
NO_CODES: Mapping[int, str] = MappingProxyType({})
DONE, ENDED = "done", "ended by Ctrl-C or SIGTERM"
WRONG_INPUT = "wrong input, or a place that cannot be written"


class Command(click.Command):
    """A command with its exit codes beside those of all.

    ``codes``: exit code -> its meaning. ``serves``: True where the command runs until Ctrl-C, its regular end.
    """

    def __init__(
        self, *arguments: Any, part: str, codes: Mapping[int, str] = NO_CODES, serves: bool = False, **options: Any
    ) -> None:
        super().__init__(*arguments, **options)
        self.part, self.serves = part, serves
        end = ENDED if serves else DONE
        last = {} if serves else {INTERRUPTED_CODE: "interrupted, by Ctrl-C or a signal"}
        self.codes = dict(sorted({0: end, 2: WRONG_INPUT, **last, **codes}.items()))

    def format_epilog(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the exit codes below the options."""
        super().format_epilog(context, formatter)
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(code), meaning) for code, meaning in self.codes.items()])


class Group(click.Group):
    """Subcommands of one subject, or, without ``part``, all commands of ``dsse`` part by part."""

    def __init__(self, *arguments: Any, part: str = "", **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.part = part

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands with their first lines, each part in a section of its own."""
        if self.part:
            super().format_commands(context, formatter)
            return
        width = max(map(len, self.commands))
        for part, of_what in PARTS.items():
            rows = [
                (f"{name:{width}}", command.get_short_help_str(LONGEST_LINE))
                for name, command in self.commands.items()
                if getattr(command, "part", "") == part
            ]
            with formatter.section(f"{part} {of_what}"):
                formatter.write_dl(rows)


def command(part: str, name: str | None = None, **options: Any) -> Callable[[Callable[..., Any]], Command]:
    """Decorator that makes a function the command ``name`` of ``part``; ``options``: as of ``Command``."""
    return click.command(name, cls=Command, part=part, **options)


def group(part: str, name: str | None = None, **options: Any) -> Callable[[Callable[..., Any]], Group]:
    """Decorator that makes a function the group of subcommands ``name``, which are all of ``part``."""
    return click.group(name, cls=Group, part=part, **options)


def list_leaves(commands: click.Group, *before: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """The words of each command below ``commands``, and the command; a group that works alone comes before its own."""
    for name, found in commands.commands.items():
        words = (*before, name)
        if not isinstance(found, click.Group):
            yield words, found
            continue
        if found.invoke_without_command:
            yield words, found
        yield from list_leaves(found, *words)


def removed_option(name: str, instead: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that refuses an option of former versions: the error says that ``instead`` took its place."""

    def refuse(_: click.Context, __: click.Parameter, value: str | None) -> None:
        if value is not None:
            raise click.UsageError(f"{name} is gone; {instead}")

    return click.option(name, "removed_" + name.strip("-"), expose_value=False, hidden=True, callback=refuse)
