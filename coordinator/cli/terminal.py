"""Parts that the commands share: arguments and options, output and progress on the terminal, the end of a run."""

from __future__ import annotations

import functools
import json
import math
import os
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agents.runtime.heap import keep_all
from coordinator.cli.command import removed_option
from coordinator.cli.figure_options import given_arguments
from coordinator.lab.process_run.compile_clock import clock
from coordinator.watch.interrupts import decide
from dsse_core.compiling import only_loading
from dsse_core.endpoints import add_protocol, check_endpoints
from dsse_core.limits import LARGEST_SEED, LONGEST_S
from dsse_core.printable import printable_lines

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from coordinator.lab.evaluation.result import RunResult
    from coordinator.watch.observe.progress import Progress
    from scenarios.faults.faults import LinkChanges
    from scenarios.scenario import Scenario

PROGRESS_LINE_S = 1.0
MAX_NAMED = 12
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
SECURE_ENDPOINT = "tls/127.0.0.1:7447"


class Number(click.FloatRange):
    """A finite number within limits; NaN passes every limit of click, so it is refused here, as infinity is."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


SECONDS = Number(min=0, min_open=True, max=LONGEST_S)

scenario_argument = click.argument("scenario")
strategy_option = click.option("--strategy", help="Use this strategy instead of the scenario's.")
seed_option = click.option(
    "--seed", type=click.IntRange(min=0, max=LARGEST_SEED), help="Use this seed instead of the scenario's."
)
timeout_option = click.option(
    "--timeout", type=SECONDS, metavar="S", help="Time limit in seconds instead of the scenario's."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead.")
quiet_option = click.option("--quiet", is_flag=True, help="Print the verdict only.")
run_id_option = click.option("--run", "run_id", help="Name of the run, a part of every key.  [default: the scenario's]")
direct_option = click.option("--direct", is_flag=True, help="There is no router: link with the endpoint of every area.")
run_option = click.option(
    "--run", "run_id", help="Name of the run.  [default: the only one on the bus; with --keys the one named there]"
)
keys_option = click.option(
    "--keys",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Show the certificate in DIR, or in its folder there (`dsse keys create`).",
)
optional_scenario_argument = click.argument("scenario", required=False)
run_folder_option = click.option(
    "--out", type=click.Path(path_type=Path), help="Run folder, new or empty.  [default: runs/SCENARIO-TIME]"
)


@contextmanager
def answering_once() -> Iterator[None]:
    """Context of a command that computes an answer and ends: it waits for no compiler, and keeps freed memory."""
    keep_all()
    with only_loading():
        yield


def set_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--set``; the command gets key -> value as ``changes``."""

    @click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Value of a scenario key; repeatable.")
    @functools.wraps(command)
    def with_changes(*arguments: Any, settings: tuple[str, ...], **options: Any) -> Any:
        changes: dict[str, object] = {}
        if settings:
            from scenarios.files.key_values import parse_settings

            changes = parse_settings(settings, "--set")
        return command(*arguments, changes=changes, **options)

    return with_changes


def changed(scenario: str, changes: Mapping[str, object], links: LinkChanges | None = None) -> str | Scenario:
    """The scenario with ``changes`` and ``links``; its name where there are none, so that the file is read later."""
    if not changes and not links:
        return scenario
    from coordinator.lab.evaluation.evaluation import choose_scenario

    return choose_scenario(scenario, links=links or {}, changes=changes)


def wait_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--wait``; the command gets it as ``timeout``."""
    wait = click.option(
        "--wait",
        "timeout",
        type=SECONDS,
        default=10.0,
        show_default=True,
        metavar="S",
        help="Wait for the bus so long.",
    )
    return wait(removed_option("--timeout", "--wait S says how long to wait for the bus")(command))


def connect_option(
    secured_by: str = "--keys", default: str | None = None
) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """``--connect``; without it ``choose_endpoints`` decides, or the rule that ``default`` states. ``secured_by``: the
    option that asks for TLS.
    """
    default = default or f"[default: {DEFAULT_ENDPOINT}; with {secured_by} {SECURE_ENDPOINT}]"
    return click.option(
        "--connect",
        "endpoints",
        multiple=True,
        callback=check_connect,
        metavar="HOST:PORT",
        help=f"Endpoint of the router; repeatable.  {default}",
    )


def check_connect(_: click.Context, parameter: click.Parameter, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """The endpoints of an option, to connect to.

    Raises:
        InvalidInputError: a text is no endpoint to connect to.
    """
    check_endpoints(parameter.opts[0], add_protocol(endpoints, secured=False))
    return endpoints


def check_listen(_: click.Context, parameter: click.Parameter, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """The endpoints of an option, to listen on.

    Raises:
        InvalidInputError: a text is no endpoint to listen on.
    """
    check_endpoints(parameter.opts[0], add_protocol(endpoints, secured=False), listens=True)
    return endpoints


def choose_endpoints(given: tuple[str, ...], secured: bool) -> tuple[str, ...]:
    """The endpoints ``given``, each with its protocol, or that of a router on this host."""
    return add_protocol(given, secured=secured) or (SECURE_ENDPOINT if secured else DEFAULT_ENDPOINT,)


def show(text: str) -> bool:
    """Print ``text`` in one piece, made printable; False where the reader of standard output has closed it."""
    try:
        sys.stdout.write(printable_lines(text) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


def answer(as_json: bool, content: Mapping[str, object], text: str) -> None:
    """Print the answer of a command: ``text``, or ``content`` as one JSON object; paths become texts."""
    show(json.dumps(content, allow_nan=False, default=str) if as_json else text)


def end_output() -> None:
    """End standard output for the reader of a pipe or file, although the process continues; a terminal stays open."""
    with suppress(OSError, ValueError):
        sys.stdout.flush()
        if not sys.stdout.isatty():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def notify(text: str) -> None:
    """Print on standard error, made printable; an error there is ignored."""
    with suppress(OSError):
        print(printable_lines(text), file=sys.stderr, flush=True)


def next_run(scenario: Path) -> str:
    """A hint with the command that runs the new file ``scenario``, quoted for a shell."""
    return f"next: {shlex.join([name_program(), 'run', str(scenario)])}"


def invite_to(report: Path) -> str:
    """A hint with the address at which a browser opens ``report``."""
    return f"open {report.resolve().as_uri()}"


def name_program() -> str:
    """The name by which a shell finds this command: ``dsse``, or the path as typed where PATH has not this one."""
    typed = sys.argv[0]
    found = shutil.which("dsse")
    is_found = found is not None and Path(typed).exists() and os.path.samefile(found, typed)
    return "dsse" if is_found or Path(typed).name != "dsse" else typed


def finish_run(result: RunResult, formats: Sequence[str] | None, parquet: bool, as_json: bool) -> int:
    """Print the verdict, write Parquet if asked for, figures and report unless ``formats`` is None, and return the exit
    code, which signals that come later do not change.
    """
    from coordinator.lab.evaluation.result import as_json as describe
    from coordinator.show.report.text import format_verdict

    code = 2 if result.unwritten else 0 if result.verdict.consensus else 1
    content, verdict = describe(result) if as_json else {}, format_verdict(result)
    decide(code)
    report = None if formats is None or result.unwritten else result.folder / "report.html"
    answer(as_json, content | {"folder": result.folder, "report": report}, verdict)
    if result.unwritten:
        return _report_unwritten(result)
    if parquet:
        from coordinator.watch.tables import write_parquet

        write_parquet(result.folder, result.tables)
    if formats is not None:
        from coordinator.show.report.run_report import write_report

        if (written := write_report(result, formats, given_arguments())).unwritten:
            return _report_unwritten(written)
    if report is not None and not as_json:
        show(invite_to(report))
    return code


def _report_unwritten(result: RunResult) -> int:
    notify(f"error: files of the run are missing: {result.unwritten}; make room there, or choose another place")
    return 2


@contextmanager
def progress(title: str, quiet: bool) -> Iterator[Callable[[Progress], None] | None]:
    """Function that shows progress, None if ``quiet``: a table in a terminal, else a line every PROGRESS_LINE_S."""
    if quiet:
        clock.notify = None
        yield None
    elif sys.stderr.isatty():
        with ExitStack() as stack:
            yield _show_live(title, stack)
    else:
        yield _print_now_and_then()


def _show_live(title: str, stack: ExitStack) -> Callable[[Progress], None]:
    table: Callable[[Progress], None] | None = None

    def show(progress: Progress) -> None:
        nonlocal table
        if table is None:
            from coordinator.watch.observe.live import live_table  # now, when the areas are at work and there is time

            table = stack.enter_context(live_table(title))
        table(progress)

    return show


def _print_now_and_then() -> Callable[[Progress], None]:
    last = 0.0

    def show(progress: Progress) -> None:
        nonlocal last
        if progress.elapsed_s - last >= PROGRESS_LINE_S:
            last = progress.elapsed_s
            if len(progress.areas) <= MAX_NAMED:
                areas = [f"{area.name} {area.state}" for area in progress.areas]
            else:
                areas = [f"{n} {state}" for state, n in sorted(Counter(a.state for a in progress.areas).items())]
            notify(f"{progress.elapsed_s:6.1f} s  {', '.join(areas)}")

    return show
