"""Types of the values in files, with their limits, the same in every kind of file."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints

from dsse_core.limits import (
    LARGEST_GROSS_ERROR,
    LARGEST_SEED,
    LARGEST_SIGMA,
    LEAST_HEARTBEAT_S,
    LONGEST_NAME,
    LONGEST_S,
    SHORTEST_SCAN_S,
    SMALLEST_SIGMA,
)


def _require_integer(value: object) -> object:
    """``value``, the number of a version; Python takes 1 for equal to 1.0 and true.

    Raises:
        ValueError: ``value`` is no integer.
    """
    if type(value) is not int:
        raise ValueError(f"must be the integer 1, found {value!r}")
    return value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(gt=0, le=LONGEST_S)]
ClockError = Annotated[float, Field(ge=-LONGEST_S, le=LONGEST_S)]
Moment = Annotated[float, Field(ge=0, le=LONGEST_S)]
HeartbeatSeconds = Annotated[float, Field(ge=LEAST_HEARTBEAT_S, le=LONGEST_S)]
ScanSeconds = Annotated[float, Field(ge=SHORTEST_SCAN_S, le=LONGEST_S)]
Milliseconds = Annotated[float, Field(ge=0, le=1000 * LONGEST_S)]
Sigma = Annotated[float, Field(ge=SMALLEST_SIGMA, le=LARGEST_SIGMA)]
GrossError = Annotated[float, Field(ge=-LARGEST_GROSS_ERROR, le=LARGEST_GROSS_ERROR)]
Seed = Annotated[int, Field(ge=0, le=LARGEST_SEED)]
Version = Annotated[Literal[1], BeforeValidator(_require_integer)]
Penalty = Annotated[float, Field(ge=1e-6, le=1e6)]
Name = Annotated[str, StringConstraints(pattern=r"^[_a-z0-9-]+$", max_length=LONGEST_NAME)]
"""Name of an area or a run: a part of keys on the bus, and of names in certificates."""
BRANCH_ID = re.compile(rf"[_a-z0-9-]{{1,{LONGEST_NAME}}}")
"""Id of a branch: the id of a meter holds it, and has a limit on the wire."""
BranchId = Annotated[str, StringConstraints(pattern=f"^{BRANCH_ID.pattern}$")]
