"""Limits of what a user may state, the same in files, on the command line and in arguments of functions.

The types of numbers state their ranges: fields of dataclasses have them, and the schemas of files take them from there.
"""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Le

LONGEST_S = 86400  # of any time: a day
SHORTEST_SCAN_S = 0.001  # between two scans
LEAST_HEARTBEAT_S = 0.001  # between two heartbeats; a shorter time leaves none for anything else
LARGEST_SEED = 2**63 - 1  # the largest integer of TOML
LONGEST_NAME = 64  # letters of the name of an area, a run or a branch; certificates have this limit of names
LARGEST_BUS = 10**15  # largest size of a bus id, which may be negative: every id is exact as a float, too
SMALLEST_SIGMA, LARGEST_SIGMA = 1e-9, 1e6  # p.u. or rad
# Limits of sigmas given in arrays: between them the square of sigma, its reciprocal and J are finite.
LEAST_USABLE_SIGMA, MOST_USABLE_SIGMA = 1e-100, 1e100
LARGEST_GROSS_ERROR = 1e9  # standard deviations of the meter

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Probability = Annotated[float, Ge(0), Le(1)]
Seconds = Annotated[float, Gt(0), Le(LONGEST_S)]
ClockError = Annotated[float, Ge(-LONGEST_S), Le(LONGEST_S)]
Moment = Annotated[float, Ge(0), Le(LONGEST_S)]
HeartbeatSeconds = Annotated[float, Ge(LEAST_HEARTBEAT_S), Le(LONGEST_S)]
ScanSeconds = Annotated[float, Ge(SHORTEST_SCAN_S), Le(LONGEST_S)]
Milliseconds = Annotated[float, Ge(0), Le(1000 * LONGEST_S)]
Sigma = Annotated[float, Ge(SMALLEST_SIGMA), Le(LARGEST_SIGMA)]
GrossError = Annotated[float, Ge(-LARGEST_GROSS_ERROR), Le(LARGEST_GROSS_ERROR)]
Seed = Annotated[int, Ge(0), Le(LARGEST_SEED)]
Penalty = Annotated[float, Ge(1e-6), Le(1e6)]
