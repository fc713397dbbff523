"""``python -m benchmarks.fleet``: a generated feeder with hundreds of areas as real processes on this machine."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click

from benchmarks.measuring.figures import figures_option, list_facts, write_section
from benchmarks.measuring.machine import describe_machine

PACKAGES = ("numpy", "scipy", "numba", "eclipse-zenoh", "consensus-dsse")
LOOK_S = 5.0  # at the memory, which takes a second of a processor where there are hundreds of processes


@click.command(context_settings={"show_default": True})
@click.option("--areas", type=click.IntRange(2), default=20, help="Areas, one process each.")
@click.option("--buses", type=click.IntRange(2), default=500, help="Buses of an area.")
@click.option("--timeout", "timeout_s", type=click.FloatRange(1), default=300.0, help="Seconds for the run.")
@figures_option
def main(areas: int, buses: int, timeout_s: float, figures: str | None) -> None:
    """Time `dsse run` of AREAS areas of BUSES buses until all areas are there and to the verdict; add up the memory."""
    with tempfile.TemporaryDirectory() as name:
        feeder, out = Path(name) / "feeder", Path(name) / "run"
        generate = ("generate", "--buses", str(areas * buses), "--areas", str(areas), "--out", str(feeder))
        subprocess.run([*_dsse(), *generate], check=True, stdout=subprocess.DEVNULL)
        arguments = ("run", str(feeder / "scenario.toml"), "--out", str(out), "--timeout", str(timeout_s), "--no-plots")
        start, spent = time.monotonic(), _processor_time()
        with subprocess.Popen([*_dsse(), *arguments], stdout=subprocess.PIPE, text=True) as process:
            most = _watch_memory(process, out)
            output = process.stdout.read() if process.stdout else ""
        wall_s = time.monotonic() - start
        machine = describe_machine(PACKAGES)
        for key, text in machine.items():
            click.echo(f"{key}: {text}")
        click.echo(f"\n{areas} areas of {buses} buses, {areas * buses} in all\n{output.strip()}\n")
        if not (out / "result.json").exists():
            raise click.ClickException(f"dsse run ended with {process.returncode} and left no result")
        facts = _summarise(json.loads((out / "result.json").read_text()), wall_s, _processor_time() - spent, most)
    click.echo("\n".join(f"{what}: {figure}" for what, figure in facts.items()))
    if figures:
        write_section(figures, machine, list_facts(facts))


def _dsse() -> list[str]:
    return [sys.executable, "-m", "coordinator"]


def _processor_time() -> float:
    """Processor time of all children that have ended, and of the children that those waited for, s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _summarise(result: dict[str, Any], wall_s: float, processor_s: float, most: dict[str, float]) -> dict[str, str]:
    """Name of a figure -> its text."""
    verdict, timing = result["verdict"], result["timing_s"]
    moments = ("scenario_loaded", "agents_started", "plant_started", "centralised_estimated", "last_change", "verdict")
    return {
        "all areas present": f"{timing.get('areas_joined', float('nan')):.1f} s after the command's own start",
        **{moment: f"{timing[moment]:.1f} s" for moment in moments if moment in timing},
        "command's end": f"{wall_s:.1f} s",
        "consensus": f"{verdict['consensus']}",
        "processor time of the command and all its processes": f"{processor_s:.0f} s",
        "gap to the centralised estimate": f"{verdict['gap_vm_pu']} p.u., {verdict['gap_va_deg']} deg",
        "messages": f"{verdict['messages']}, {verdict['bytes']} bytes, {verdict['exchanges']} exchanges",
        **{f"most memory (PSS) of {name}": f"{mebibytes:.0f} MiB" for name, mebibytes in most.items()},
    }


def _watch_memory(process: subprocess.Popen[str], out: Path) -> dict[str, float]:
    """Largest memory of the command, of the run's other processes and of all together, until the command ends, MiB."""
    most: dict[str, float] = {}
    while process.poll() is None:
        parent = _find_parent(out)
        group = _processes_of(parent) if parent else []
        found = {"the command": _pss(process.pid), "all other processes": sum(map(_pss, group))}
        found["all at one time"] = sum(found.values())
        most = {name: max(value, most.get(name, 0.0)) for name, value in found.items()}
        time.sleep(LOOK_S)
    return most


def _find_parent(out: Path) -> int | None:
    """Process id of the warmed parent, which leads the process group of all others."""
    try:
        first = (out / "events.jsonl").read_text().partition("\n")[0]
        return int(json.loads(first)["parent_pid"])
    except (OSError, ValueError, KeyError):
        return None


def _processes_of(group: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if int(fields[2]) == group:
            found.append(int(path.parent.name))
    return found


def _pss(pid: int) -> float:
    """Proportional set size, MiB; 0 of a process that is gone."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:")), 0.0)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.fleet")
