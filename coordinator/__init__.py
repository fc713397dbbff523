"""Launches router, plant and agents, watches them, compares and reports; the command line.

``coordinator.run(scenario)`` is what ``dsse run`` does, ``coordinator.simulate(scenario)`` what ``dsse simulate``
does. Importing this package imports nothing heavy: a process that becomes an agent must not import what only the
coordinator needs.

Part of consensus-dsse.
"""

from __future__ import annotations

import time

TYPE_CHECKING = False  # as that of ``typing``, which would take longer to import than all else here
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from coordinator.show.plotted_run import RunResult
    from coordinator.watch.observe.progress import Progress
    from scenarios.faults.faults import LinkChanges
    from scenarios.scenario import Scenario

__all__ = ["run", "simulate"]


def run(
    scenario: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    seed: int | None = None,
    strategy: str | None = None,
    timeout_s: float | None = None,
    changes: Mapping[str, object] | None = None,
    on_update: Callable[[Progress], None] | None = None,
    plots: bool = True,
    formats: Sequence[str] = ("png",),
    secure: bool = False,
    keys: str | Path | None = None,
) -> RunResult:
    """Run a scenario as real processes until its areas agree, and compare them with the centralised estimate.

    Args:
        scenario: name of a shipped scenario, path of a scenario file, or a loaded one.
        out: the run folder, new or empty; by default ``runs/<scenario>-<time>``.
        seed, strategy: replace the scenario's.
        timeout_s: replaces the scenario's time limit, s.
        changes: key path -> value in its place, as of ``--set``; for a scenario that is not loaded yet.
        on_update: called about ten times a second with what the areas are doing.
        plots: draw the figures and write ``report.html``, too.
        formats: of the figures: ``png``, ``pdf``, ``svg``.
        secure: TLS with a certificate for each process, and access control, with keys that end with the run.
        keys: folder with keys of ``dsse keys create`` to use instead; implies ``secure``.

    Returns:
        The verdict, the tables ``buses``, ``branches``, ``meters`` and ``areas``, whose columns name their units, and
        figures by ``plot()``.

    >>> import consensus_dsse as dsse
    >>> result = dsse.run("ieee33", out="my-run", plots=False)
    >>> result.verdict.consensus, result.buses.vm_kv.shape
    (True, (33,))

    Raises:
        InvalidInputError: the scenario, the folder or the keys cannot be used.
        TransportError: the router cannot listen where the scenario says.
    """
    started = time.monotonic()
    from coordinator.lab.process_run.processes import Launcher

    with Launcher() as launcher:  # the other processes' imports run beside ours
        launcher.preload("coordinator.lab.process_run.router_process", "agents.__main__", "coordinator.lab.plant.plant")
        if secure or keys is not None:
            launcher.preload("agents.security.access_file", "agents.security.certificate_checks")
        from coordinator.lab.evaluation.evaluation import choose_scenario
        from coordinator.lab.process_run.run_scenario import run_scenario

        scenario = choose_scenario(scenario, changes=changes) if changes else scenario
        result = run_scenario(launcher, scenario, started, out, seed, strategy, timeout_s, on_update, secure, keys)
    if plots:
        from coordinator.show.report.run_report import write_report
        from coordinator.show.report.settings import guess_arguments

        secured = ["--keys", str(keys)] if keys is not None else ["--secure"] if secure else []
        result = write_report(result, formats, [*guess_arguments(result.scenario, "run"), *secured])
    from coordinator.show.plotted_run import RunResult

    return RunResult.of(result)


def simulate(
    scenario: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    seed: int | None = None,
    strategy: str | None = None,
    timeout_s: float | None = None,
    changes: Mapping[str, object] | None = None,
    links: LinkChanges | None = None,
    on_update: Callable[[Progress], None] | None = None,
    plots: bool = True,
    formats: Sequence[str] = ("png",),
) -> RunResult:
    """Run a scenario on the simulator: the same areas on a simulated bus, in virtual time, in this process.

    The same scenario, seed and links give the same result to the bit. Arguments are those of ``run``, and:

    Args:
        links: ``loss``, ``delay_s``, ``jitter_s`` or ``duplicate`` of every link, in place of the scenario's.

    >>> import consensus_dsse as dsse
    >>> result = dsse.simulate("ieee33", changes={"faults.loss": 0.3}, out="my-simulation", plots=False)
    >>> result.verdict.consensus, result.areas.area
    (True, ('area1', 'area2', 'area3'))

    Raises:
        InvalidInputError: the scenario, the folder or a link fault cannot be used.
    """
    from coordinator.lab.evaluation.evaluation import choose_scenario
    from coordinator.lab.simulator.simulate import simulate_scenario

    scenario = choose_scenario(scenario, changes=changes) if changes else scenario
    result = simulate_scenario(scenario, out, seed, strategy, timeout_s, on_update, links or {})
    if plots:
        from coordinator.show.report.run_report import write_report
        from coordinator.show.report.settings import guess_arguments

        result = write_report(result, formats, guess_arguments(result.scenario, "simulate", links))
    from coordinator.show.plotted_run import RunResult

    return RunResult.of(result)
