"""The errors of the package: each text names the problem, its place and the cure."""

import re
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from dsse_core.printable import listed, printable, printable_lines, shortened_inside

BELIEVABLE = 5.0  # sigma; one reading in two million is farther off by noise alone
MOST_SHOWN = 50  # problems of one input that are shown; further problems are counted
LONGEST_LINE = 1000  # characters; a longer line keeps its beginning, the place, and its end, the cure
MOST_NAMED = 100  # buses in one text
POSITION = re.compile(r"\w\[\d+\]")
"""The position of an item of a list in a key path."""


class DsseError(Exception):
    """Base of every error that a caller may want to catch; its text is meant for the user: printable, no line of it
    longer than ``LONGEST_LINE``."""

    def __str__(self) -> str:
        return "\n".join(
            shortened_inside(line, LONGEST_LINE) for line in printable_lines(super().__str__()).split("\n")
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """The text and the attributes, from which the error is restored in another process without ``__init__``, whose
        arguments differ from class to class.
        """
        return _restore, (type(self), self.args), self.__dict__


def _restore(kind: type[DsseError], args: tuple[Any, ...]) -> DsseError:
    """An error of class ``kind`` as before its attributes are set."""
    return kind.__new__(kind, *args)


class InvalidInputError(DsseError):
    """Input that cannot be used. ``problems`` holds every problem found, not only the first, on one line each; the text
    has the first ``MOST_SHOWN`` and counts the rest.
    """

    def __init__(self, what: str, problems: Sequence[str]) -> None:
        self.what = printable(what)
        self.problems = tuple(map(printable, problems))
        count = f"{len(self.problems)} problem" + ("s" if len(self.problems) != 1 else "")
        shown = self.problems[:MOST_SHOWN]
        more = [f"  ... and {len(self.problems) - len(shown):,} more"] if len(shown) < len(self.problems) else []
        note = ["(items of lists count from 1)"] if any(map(POSITION.search, shown)) else []
        super().__init__("\n".join([f"{self.what}: {count}", *(f"  - {p}" for p in shown), *more, *note]))


class PowerFlowDivergedError(DsseError):
    """Newton's iteration did not reach the tolerance; names the bus with the largest mismatch."""

    def __init__(self, network: str, bus: int, mismatch: float, iterations: int) -> None:
        self.bus = bus
        self.mismatch = mismatch
        self.iterations = iterations
        super().__init__(
            f"power flow of {network!r} did not converge in {iterations} iterations: the largest mismatch "
            f"is {mismatch:.3g} p.u. at bus {bus}; check the load, the branches and the units around that bus"
        )


class NotObservableError(DsseError):
    """The measurements do not determine the state; names the buses, with phases such as "645.b", and a cure.

    ``cures``: meters each of which would do if it were added. ``together``: else a few that would together.
    ``left_out``: meters that are not believed, each with its reading, as text.
    """

    def __init__(
        self,
        buses: Sequence[int | str],
        cures: Sequence[str],
        left_out: Sequence[str] = (),
        together: Sequence[str] = (),
    ) -> None:
        self.buses = tuple(buses)
        self.cures = tuple(cures)
        self.left_out = tuple(left_out)
        self.together = tuple(together)
        names = listed(_join_phases(self.buses), MOST_NAMED)
        remedy = "no single added meter would cure it; add meters among these buses"
        if self.cures:
            remedy = "any one of these added meters would cure it: " + listed(self.cures, separator="; ")
        elif self.together:
            remedy = (
                f"no single added meter would cure it, together these would: {listed(self.together, separator='; ')}"
            )
        them = "it" if len(self.left_out) == 1 else "them"
        without = f"{listed(self.left_out, separator='; ')}: left out as dead; without {them} " if self.left_out else ""
        super().__init__(f"{without}the measurements do not determine the state of bus {names}; {remedy}")


def _join_phases(nodes: Sequence[int | str]) -> list[int | str]:
    """``nodes`` as text with those of one bus, which follow each other, as one, such as "645 (b, c)"."""
    joined: list[int | str] = []
    for bus, of_bus in groupby(nodes, key=lambda node: str(node).partition(".")[0]):
        known = list(of_bus)
        phases = ", ".join(str(node).partition(".")[2] for node in known)
        joined.append(known[0] if len(known) == 1 else f"{bus} ({phases})")
    return joined


class EstimationDivergedError(DsseError):
    """The Gauss-Newton iteration did not converge; the text names the cause and the cure.

    ``meter``: id of the meter whose reading is the cause, empty where no reading is known to be. ``reason``: that of
    ``decision``, "diverged", or "out of reach" where a step leads farther than all steps of a start.
    """

    def __init__(self, iterations: int, step: float, cause: str, meter: str = "", reason: str = "diverged") -> None:
        self.reason = reason
        self.iterations = iterations
        self.step = step
        self.cause = cause
        self.meter = meter
        super().__init__(
            f"state estimation did not converge in {iterations} iterations ({reason}, last step {step:.3g}); {cause}"
        )
