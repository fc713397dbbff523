"""The state that an area shows to whoever watches: composed when it changes, renewed with its ages at every beat."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from agents.area_file import AreaFile
from agents.hearing import Hearing
from agents.messages import Header, Message, StateMessage, content_of
from agents.quality import DEGRADED, EstimateLimits, Finding, Worth, find_doubts, weigh
from agents.strategies.interface import Estimate

Sent = Mapping[str, Message]


class ShownState:
    """``message``: the state as last shown, None before the first.

    Args:
        header_for: the header of a message that follows the given one.
    """

    def __init__(self, content: AreaFile, hearing: Hearing, header_for: Callable[[Message | None], Header]) -> None:
        self.message: StateMessage | None = None
        self._buses = tuple(bus.id for bus in content.area.network.buses)
        self._limits = EstimateLimits(content.limits, self._buses, content.meters)
        self._neighbours = [n.area for n in content.area.neighbours]
        self._hearing = hearing
        self._header_for = header_for
        self._estimate: Estimate | None = None
        self._findings: tuple[Finding, ...] = ()  # that hold until the next estimate
        self._notes: tuple[str, ...] = ()
        self._scan = 0

    def change(
        self,
        estimate: Estimate | None,
        notes: Sequence[str],
        remarks: Iterable[Finding],
        sent: tuple[Sent, Sent],
        gone: Mapping[str, str],
        refused: Mapping[str, int],
        now: float,
    ) -> StateMessage | None:
        """Show ``estimate`` as things are at time ``now``; the state to be published, None if it says nothing new.

        ``notes``: what is missing or contradicts. ``remarks``: what else is to be told. ``sent``: the last load and
        boundary message to each neighbour. Under the number of the last state only its quality, notes, ages and counts
        may change.
        """
        last, scan = self.message, self._hearing.scan
        self._estimate, self._notes, self._scan = estimate, tuple(notes), scan
        self._findings = (*remarks, *(self._limits.find_breaches(estimate) if estimate else ()))
        state = self._compose(estimate, sent, gone, refused, now)
        if last is not None and content_of(last) == content_of(state):
            if (last.quality, last.notes, last.header.scan) == (state.quality, state.notes, scan):
                return None
            if last.header.scan == scan:
                state = replace(state, header=replace(last.header, time=state.header.time))
        self.message = state
        return state

    def _compose(
        self,
        estimate: Estimate | None,
        sent: tuple[Sent, Sent],
        gone: Mapping[str, str],
        refused: Mapping[str, int],
        now: float,
    ) -> StateMessage:
        """The state but for what the links have counted, which they fill in."""
        heard = (self._hearing.loads, self._hearing.boundary)
        return StateMessage(
            header=self._header_for(self.message),
            **describe_estimate(estimate, self._buses),
            sent={name: _sequences(name, *sent) for name in self._neighbours},
            heard={name: _sequences(name, *heard) for name in self._neighbours},
            messages=0,
            bytes=0,
            lost=0,
            faults={},
            **self._passing(gone, refused, now),
        )

    def renew(self, gone: Mapping[str, str], refused: Mapping[str, int], now: float) -> StateMessage:
        """The state with the quality, the notes, the ages and the counts of time ``now``."""
        assert self.message is not None
        header = replace(self.message.header, time=self._header_for(None).time)
        self.message = replace(self.message, header=header, **self._passing(gone, refused, now))
        return self.message

    def _passing(self, gone: Mapping[str, str], refused: Mapping[str, int], now: float) -> dict[str, Any]:
        """The fields that are renewed at every beat."""
        worth = self._weigh(gone, now)
        return {
            "quality": worth.word,
            "notes": worth.notes,
            "telemetry_age": self._hearing.telemetry_age(now),
            "ages": self._hearing.ages(now),
            "scans": self._hearing.scans(),
            "old_sides": self._hearing.old_sides(),
            "refused": dict(refused),
        }

    def has_aged(self, gone: Mapping[str, str], now: float) -> bool:
        """Whether the quality of the state is no longer what it was when it was shown."""
        return self.message is not None and self.message.quality != self._weigh(gone, now).word

    def _weigh(self, gone: Mapping[str, str], now: float) -> Worth:
        """The state as last shown; new readings leave it behind until they have been worked in."""
        findings = [
            *find_doubts(self._estimate, self._notes, self._hearing, self._neighbours, gone, now),
            *self._findings,
        ]
        if self._estimate is not None and self._scan != self._hearing.scan:
            findings.append(Finding(DEGRADED, "newer readings have not been worked in"))
        return weigh(findings)


def describe_estimate(estimate: Estimate | None, buses: tuple[int, ...]) -> dict[str, Any]:
    """The fields of a state that ``estimate`` fills; without one all are empty."""
    if estimate is None:
        empty: dict[str, Any] = dict.fromkeys(("buses", "vm", "va", "sigma_vm", "sigma_va", "removed", "critical"), ())
        return empty | {"referenced": False, "objective": 0.0, "degrees_of_freedom": 0, "checked": False}
    return {
        "buses": buses,
        "vm": tuple(estimate.vm.tolist()),
        "va": tuple(estimate.va.tolist()),
        "sigma_vm": tuple(estimate.sigma_vm.tolist()),
        "sigma_va": tuple(estimate.sigma_va.tolist()),
        "referenced": estimate.referenced,
        "objective": estimate.objective,
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "removed": estimate.removed,
        "critical": estimate.critical,
        "checked": estimate.checked,
    }


def _sequences(name: str, loads: Sent, boundary: Sent) -> tuple[int, int]:
    load, state = (kept[name].header.sequence if name in kept else 0 for kept in (loads, boundary))
    return load, state
