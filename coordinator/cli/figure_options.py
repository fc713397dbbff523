"""Options for figures: their formats, or no figures at all."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click

FORMATS = ("png", "pdf", "svg")


def _read_formats(_: click.Context, __: click.Parameter, text: str | None) -> tuple[str, ...] | None:
    found = tuple(dict.fromkeys(part.strip().lower() for part in (text or "").split(",")))
    if text is None:
        return None
    if unknown := [part for part in found if part not in FORMATS]:
        raise click.BadParameter(f"{', '.join(map(repr, unknown))}: choose of {', '.join(FORMATS)}")
    return found


def figure_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--format`` and ``--no-plots``; the command gets ``formats``, None with ``--no-plots``."""

    @click.option(
        "--format",
        "formats",
        callback=_read_formats,
        metavar="A,B,...",
        help="Of figures: png, pdf, svg.  [default: png]",
    )
    @click.option("--no-plots", is_flag=True, help="Draw no figures, write no report.")
    @functools.wraps(command)
    def with_formats(*arguments: Any, formats: tuple[str, ...] | None, no_plots: bool, **options: Any) -> Any:
        if formats and no_plots:
            raise click.UsageError("--format draws figures, --no-plots none; give one of them")
        return command(*arguments, formats=None if no_plots else formats or FORMATS[:1], **options)

    return with_formats


def asked_for_formats() -> bool:
    """True where this command was given ``--format``."""
    return bool(click.get_current_context().params.get("formats"))


def given_arguments() -> tuple[str, ...]:
    """The arguments of this command as they were given, by which a report says how to repeat it."""
    return tuple(click.get_current_context().find_root().obj or ())
