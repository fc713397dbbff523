"""Decentralised state estimation of power grids from Python: ``import consensus_dsse as dsse``.

``run``, ``simulate``, ``compare`` and ``sweep`` do what the commands of ``dsse`` do; ``estimate`` and ``power_flow``
give the state that a control centre finds and the true one, ``estimate_batch`` estimates many scans at once. Results
have the tables ``buses``, ``branches``, ``meters`` and ``areas``: columns by name, ``to_pandas()``, ``to_csv()``; and
``plot()``. Everything is imported when it is first used.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as that of ``typing``, which would take longer to import than all else here
if TYPE_CHECKING:
    from consensus_dsse.centralised import Estimate, PowerFlow, estimate, power_flow
    from consensus_dsse.grids import load_network, load_scenario
    from consensus_dsse.studies import compare, sweep, thesis
    from coordinator import run, simulate
    from coordinator.show.plotted_run import RunResult
    from dsse_core.errors import DsseError, InvalidInputError
    from dsse_core.estimation.batch import estimate_batch
    from dsse_core.estimation.plan import build_estimation_plan
    from dsse_core.results.table import Table

__all__ = [
    "DsseError",
    "Estimate",
    "InvalidInputError",
    "PowerFlow",
    "RunResult",
    "Table",
    "build_estimation_plan",
    "compare",
    "estimate",
    "estimate_batch",
    "load_network",
    "load_scenario",
    "power_flow",
    "run",
    "simulate",
    "sweep",
    "thesis",
]

_MODULES = {
    "DsseError": "dsse_core.errors",
    "Estimate": "consensus_dsse.centralised",
    "InvalidInputError": "dsse_core.errors",
    "PowerFlow": "consensus_dsse.centralised",
    "RunResult": "coordinator.show.plotted_run",
    "Table": "dsse_core.results.table",
    "build_estimation_plan": "dsse_core.estimation.plan",
    "compare": "consensus_dsse.studies",
    "estimate": "consensus_dsse.centralised",
    "estimate_batch": "dsse_core.estimation.batch",
    "load_network": "consensus_dsse.grids",
    "load_scenario": "consensus_dsse.grids",
    "power_flow": "consensus_dsse.centralised",
    "run": "coordinator",
    "simulate": "coordinator",
    "sweep": "consensus_dsse.studies",
    "thesis": "consensus_dsse.studies",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'consensus_dsse' has no attribute {name!r}; it has {', '.join(__all__)}")
    import importlib

    from consensus_dsse.own_packages import check_own_packages

    check_own_packages()
    found = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return list(__all__)
