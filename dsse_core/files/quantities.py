"""What a value in a file may be, the same in every kind of file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StringConstraints

from dsse_core.limits import LARGEST_SIGMA, LONGEST_NAME, LONGEST_S, SHORTEST_SCAN_S, SMALLEST_SIGMA

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(gt=0, le=LONGEST_S)]
Moment = Annotated[float, Field(ge=0, le=LONGEST_S)]
ScanSeconds = Annotated[float, Field(ge=SHORTEST_SCAN_S, le=LONGEST_S)]
Milliseconds = Annotated[float, Field(ge=0, le=1000 * LONGEST_S)]
Sigma = Annotated[float, Field(ge=SMALLEST_SIGMA, le=LARGEST_SIGMA)]
Seed = Annotated[int, Field(ge=0)]
Penalty = Annotated[float, Field(ge=1e-6, le=1e6)]
Name = Annotated[str, StringConstraints(pattern=r"^[_a-z0-9-]+$", max_length=LONGEST_NAME)]
"""Of an area or a run: a part of keys on the bus, and of names in certificates."""
