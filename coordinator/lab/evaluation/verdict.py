"""The verdict of a run: consensus or the reason against it, and the gap to the centralised estimate."""

from __future__ import annotations

from dataclasses import dataclass

from coordinator.lab.evaluation.comparison import Comparison
from coordinator.watch.observe.observer import Observer


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer of a run. ``gap``: to the centralised estimate; ``error``: to the truth; None where not known.

    ``gap_at``: the node of the largest gap, such as 671.b, or 18 in a balanced network.
    ``reason``: of no consensus, else None. ``messages``, ``bytes``, ``lost``: totals of all areas up to their
    last report, repeats included. ``wall_s``: from the call to the verdict. ``virtual_s``: the same on the
    simulator's clock, None in a run of processes.
    """

    consensus: bool
    reason: str | None
    gap_vm_pu: float | None
    gap_va_deg: float | None
    gap_at: str | None
    error_vm_pu: float | None
    error_va_deg: float | None
    exchanges: int
    messages: int
    bytes: int
    lost: int
    wall_s: float
    virtual_s: float | None


def make_verdict(
    observer: Observer, comparison: Comparison, reason: str | None, wall_s: float, virtual_s: float | None = None
) -> Verdict:
    """The verdict from the areas' last states; ``reason``: None at consensus."""
    states = observer.states.values()
    gap, error = comparison.gap, comparison.error
    return Verdict(
        consensus=reason is None,
        reason=reason,
        gap_vm_pu=gap.vm_pu,
        gap_va_deg=gap.va_deg,
        gap_at=comparison.gap_at,
        error_vm_pu=error.vm_pu,
        error_va_deg=error.va_deg,
        exchanges=observer.exchanges,
        messages=sum(state.messages for state in states),
        bytes=sum(state.bytes for state in states),
        lost=sum(state.lost for state in states),
        wall_s=wall_s,
        virtual_s=virtual_s,
    )
