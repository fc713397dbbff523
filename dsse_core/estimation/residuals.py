"""Tests of readings by their residuals: the chi-square test, normalised residuals, ties, and dead voltmeters.

The areas and the centralised estimator have the same rules. ``decision``, ``bad_data`` and ``feeder_bad_data`` apply
them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import QUANTITY, number_kinds
from dsse_core.grid.quantities import Quantity

CONFIDENCE = 0.99  # of the chi-square test that asks for normalised residuals
FALSE_ALARMS = 1e-4  # share of scans of sound readings that lose ``good``, and that accuse a gateway, each at most
THRESHOLD = 3.0  # of normalised residuals
TIE = 1e-6  # relative difference of normalised residuals that are equal in exact arithmetic
# Omega_ii / R_ii below which a residual says nothing about its measurement: meters 1e6 times coarser leave as much.
CRITICAL_REDUNDANCY = 1e-12
# Least (R_ii - Omega_ii) / R_ii, the variance of the estimated reading over that of the meter. Below it the meter says
# next to nothing about its quantity, and the difference would lose more than four digits.
LEAST_REDUCTION = 1e-4
SWITCH = "switch@"
TAP = re.compile(r"tap@(?P<branch>.+):(?P<steps>[+-][0-9]+)")
DEAD_VM = 0.5  # p.u.; no grid works below it, but least squares find states that come close to such a reading


@lru_cache(maxsize=1024)
def chi_square_limit(degrees_of_freedom: int, confidence: float) -> float:
    """The value that J exceeds with probability 1 - ``confidence`` under noise alone; inf without redundancy."""
    from scipy.special import chdtri  # 0.1 s, which an agent without bad-data processing need not wait for

    return float(chdtri(degrees_of_freedom, 1 - confidence)) if degrees_of_freedom > 0 else float("inf")


@dataclass(frozen=True, eq=False)
class MeterChecks:
    """Checks of the ``meters`` of an area or of the whole grid by an estimate; arrays (n_meas,).

    ``residual``: z - h(x); ``variance``: diag(Omega); ``real``: not virtual. ``find_indispensable``: finds the meters
    that are indispensable at no load, (n_meas,); ``find_others``: taps and switches that stand out, by ``name_tap`` and
    ``name_switch``, with their normalised residuals. Both are called only where needed.
    """

    meters: Sequence[Meter]
    residual: np.ndarray
    variance: np.ndarray
    sigma: np.ndarray
    real: np.ndarray
    find_indispensable: Callable[[], np.ndarray]
    find_others: Callable[[], Mapping[str, float]] = dict

    @cached_property
    def normalized(self) -> np.ndarray:
        """|r_i| / sqrt(Omega_ii) (eq. 3.23); 0 for virtual measurements and where Omega_ii is 0."""
        telling = self.real & (self.variance > CRITICAL_REDUNDANCY * self.sigma**2)
        return np.where(telling, abs(self.residual) / np.sqrt(np.where(telling, self.variance, 1.0)), 0.0)

    @cached_property
    def critical(self) -> tuple[str, ...]:
        """Ids of the meters without redundancy, in their order.

        Without such a meter the state is not observable. Its residual is zero whatever it reads, or nearly so where
        losses or current magnitudes check it a little.
        """
        unchecked = (self.variance <= CRITICAL_REDUNDANCY * self.sigma**2) | self.find_indispensable()
        return tuple(self.meters[k].id for k in np.flatnonzero(unchecked & self.real).tolist())

    @cached_property
    def _others(self) -> dict[str, float]:
        return dict(self.find_others())

    def suspects(self, threshold: float = THRESHOLD) -> tuple[dict[str, float], dict[str, float]]:
        """Meter, tap or switch -> its normalised residual, for those above ``threshold``; two parts, see
        ``split_suspects``.
        """
        above = np.flatnonzero(self.normalized > threshold).tolist()
        found = {self.meters[k].id: float(self.normalized[k]) for k in above}
        return split_suspects(found | self._others, set(self.critical))


def name_tap(branch: str, steps: int) -> str:
    """The name of a tap among suspects, ``steps`` above the ``tap`` of its branch: "tap@7-8:+2"."""
    return f"tap@{branch}:{steps:+d}"


def describe_tap(branch: str, steps: int) -> str:
    """The name of a tap that stands out, and what to check."""
    where = f"{abs(steps)} step{'s' * (abs(steps) > 1)} {'above' if steps > 0 else 'below'} its tap_ratio"
    return f"{name_tap(branch, steps)} stands out: check whether the tap of branch {branch} is {where}, then its meters"


def find_taps(suspects: Iterable[str]) -> dict[str, int]:
    """Branch -> steps, of those ``suspects`` that are taps, see ``name_tap``."""
    found = (TAP.fullmatch(name) for name in suspects)
    return {match["branch"]: int(match["steps"]) for match in found if match}


def name_switch(branch: str) -> str:
    """The name of a switch among suspects: "switch@18-33"."""
    return f"{SWITCH}{branch}"


def find_switches(suspects: Iterable[str]) -> tuple[str, ...]:
    """Those of the ``suspects`` that are switches, by the ids of their branches, see ``name_switch``."""
    return tuple(name.removeprefix(SWITCH) for name in suspects if name.startswith(SWITCH))


def keep_tied(suspects: Mapping[str, float]) -> dict[str, float]:
    """The largest of ``suspects``, meter -> normalised residual, and those that equal it, by id."""
    least = max(suspects.values(), default=0.0) * (1 - TIE)
    return {meter: suspects[meter] for meter in sorted(suspects) if suspects[meter] >= least}


def keep_equal(suspects: Mapping[str, float], largest: Mapping[str, float]) -> dict[str, float]:
    """The meters of ``suspects`` whose residual equals the ``largest``, which ``keep_tied`` has found, by id."""
    size = max(largest.values(), default=0.0)
    return {meter: suspects[meter] for meter in sorted(suspects) if abs(suspects[meter] - size) <= TIE * size}


def split_suspects(
    suspects: Mapping[str, float], critical: Collection[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Two parts of ``suspects``, meter -> normalised residual: meters that may go, and ``critical`` ones.

    The first part has the largest residual of the meters that are not critical, and its equals. The second part has the
    critical meters whose residual equals these.
    """
    worst = keep_tied({meter: value for meter, value in suspects.items() if meter not in critical})
    return worst, keep_equal({meter: value for meter, value in suspects.items() if meter in critical}, worst)


def find_dead(meters: Sequence[Meter], values: Sequence[float] | np.ndarray) -> list[int]:
    """Positions of the voltmeters that read less than DEAD_VM.

    Dead voltmeters are never believed: the other meters alone determine the state, or it is not observable. Several
    dead voltmeters do not confirm each other.
    """
    dead = (QUANTITY[number_kinds(meters)] == Quantity.VM) & (np.asarray(values) < DEAD_VM)
    return np.flatnonzero(dead).tolist()
