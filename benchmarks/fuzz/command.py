"""``python -m benchmarks.fuzz messages --count 1000000``: hostile inputs for every decoder, repeatable by their number.

Input k of a seed is always the same. They are read in processes of limited memory; an input that takes too long, ends
its process or raises anything but the error that is promised is a finding, which is saved.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported

import logging
import multiprocessing
import random
import signal
import tempfile
import time
import traceback
from collections import Counter
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import click

from benchmarks.fuzz.targets import TARGETS
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.limits import GIB
from benchmarks.measuring.machine import describe_machine

GROUPS = {
    "messages": ("messages",),
    "scenarios": ("scenario.toml", "network.toml", "network.json", "area.toml", "area.json", "readings.csv"),
    "importers": ("matpower.m", "pandapower.json", "power_grid_model.json"),
    "parsers": (
        "keys.toml",
        "lenient-network.json",
        "lenient-area.json",
        "lenient-power_grid_model.json",
        "foreign-pandapower.json",
    ),
}
PACKAGES = ("msgspec", "pydantic")
LONGEST_S = 30.0  # of one input
MOST_MEMORY = 4 * GIB
BATCH = 1000
FINDING = "FINDING"


class TooLongError(BaseException):
    """An input exceeded its time limit; no ``Exception``, so that no reader takes it for a mistake in the input."""


def make_input(name: str, seed: int, number: int) -> bytes:
    return TARGETS[name].make(random.Random(f"{name}/{seed}/{number}"))


def try_input(name: str, content: bytes, folder: Path) -> str:
    """``accepted``, the reason of a rejection, or ``FINDING`` and the error."""
    try:
        return TARGETS[name].read(content, folder / name)
    except TooLongError:
        return f"{FINDING}: took more than {LONGEST_S:g} s"
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        return f"{FINDING}: {type(error).__name__} in {where}: {ascii(str(error))[:200]}"


def _raise_too_long(*_: object) -> None:
    raise TooLongError


def _run_batch(name: str, seed: int, numbers: range, doing: Any, sender: Any) -> None:
    """Read the inputs ``numbers`` in a process of its own; ``doing`` holds the number of the input under way."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, _raise_too_long)
    logging.disable()
    outcomes: Counter[str] = Counter()
    findings: dict[int, str] = {}
    with tempfile.TemporaryDirectory(prefix="dsse-fuzz-") as folder:
        for number in numbers:
            doing.value = number
            content = make_input(name, seed, number)
            signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
            outcome = try_input(name, content, Path(folder))
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            outcomes[outcome.split(":")[0]] += 1
            if outcome.startswith(FINDING):
                findings[number] = outcome
    sender.send((outcomes, findings))


class Batch:
    """A process that works on ``numbers``; if it dies or hangs, another process works on the rest."""

    def __init__(self, name: str, seed: int, numbers: range) -> None:
        context = multiprocessing.get_context("fork")
        self.name, self.seed, self.numbers = name, seed, numbers
        self.receiver, sender = context.Pipe(duplex=False)
        self._doing = context.Value("q", numbers.start)
        self._seen, self._since = numbers.start, time.monotonic()
        self._process = context.Process(target=_run_batch, args=(name, seed, numbers, self._doing, sender), daemon=True)
        self._process.start()
        sender.close()

    def stop_if_stuck(self) -> None:
        """Kill the process beyond twice the alarm, which code outside Python does not notice."""
        if self._doing.value != self._seen:
            self._seen, self._since = self._doing.value, time.monotonic()
        elif time.monotonic() - self._since > 2 * LONGEST_S:
            self._process.kill()

    def finish(self) -> tuple[Counter[str], dict[int, str], range]:
        """Outcomes, findings, and the numbers that are left."""
        try:
            outcomes, findings = self.receiver.recv()
            left = range(0)
        except EOFError:
            self._process.join()
            number = self._doing.value
            findings = {number: f"{FINDING}: its process ended with exit code {self._process.exitcode}"}
            outcomes, left = (
                Counter({FINDING: 1, "not counted": number - self.numbers.start}),
                range(number + 1, self.numbers.stop),
            )
        self._process.join()
        self.receiver.close()
        return outcomes, findings, left


def fuzz(name: str, seed: int, count: int, workers: int) -> tuple[Counter[str], dict[int, str]]:
    """Read inputs 0 to ``count`` of ``name``; outcomes and findings."""
    waiting = [range(k, min(k + BATCH, count)) for k in range(0, count, BATCH)][::-1]
    outcomes: Counter[str] = Counter()
    findings: dict[int, str] = {}
    running: dict[Any, Batch] = {}
    while waiting or running:
        while waiting and len(running) < workers:
            batch = Batch(name, seed, waiting.pop())
            running[batch.receiver] = batch
        for receiver in wait(list(running), timeout=1.0):
            more, found, left = running.pop(receiver).finish()
            outcomes.update(more)
            findings |= found
            if left:
                waiting.append(left)
        for batch in running.values():
            batch.stop_if_stuck()
    return outcomes, findings


@click.command(context_settings={"show_default": True})
@click.argument("group", type=click.Choice([*GROUPS]))
@click.option("--count", type=click.IntRange(1), default=1000, help="Inputs for each decoder of the group.")
@click.option("--only", type=click.Choice([*TARGETS]), help="One decoder of the group.")
@click.option("--seed", type=int, default=1)
@click.option("--workers", type=click.IntRange(1), default=2)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("runs/fuzz"))
@figures_option
def main(group: str, count: int, only: str | None, seed: int, workers: int, out: Path, figures: str | None) -> None:
    """Feed hostile inputs to decoders. Exits with 1 if anything but acceptance or the promised rejection happens."""
    bad, lines = False, ["| decoder | seed | inputs | outcomes |", "|---|---|---|---|"]
    for name in [only] if only else GROUPS[group]:
        started = time.monotonic()
        make_input(name, seed, 0)  # the samples, before the processes that share them
        outcomes, findings = fuzz(name, seed, count, workers)
        summary = ", ".join(f"{n} {outcome}" for outcome, n in outcomes.most_common())
        click.echo(f"{name}, seed {seed}, {count} inputs, {time.monotonic() - started:.0f} s: {summary}")
        lines.append(f"| `{name}` | {seed} | {count} | {summary} |")
        for number, what in sorted(findings.items()):
            out.mkdir(parents=True, exist_ok=True)
            saved = out / f"{seed}-{number}-{name}"
            saved.write_bytes(make_input(name, seed, number))
            click.echo(f"  input {number}: {what}; saved as {saved}")
        bad |= bool(findings)
    if figures:
        write_section(figures, describe_machine(PACKAGES), "\n".join(lines))
    if bad:
        raise SystemExit(1)
