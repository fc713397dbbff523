"""Types of texts and versions in files, the same in every kind of file; those of numbers are in ``limits.py``."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import BeforeValidator, StringConstraints

from dsse_core.limits import LONGEST_NAME


def _require_integer(value: object) -> object:
    """``value``, the number of a version; Python takes 1 for equal to 1.0 and true.

    Raises:
        ValueError: ``value`` is no integer.
    """
    if type(value) is not int:
        raise ValueError(f"must be the integer 1, found {value!r}")
    return value


Version = Annotated[Literal[1], BeforeValidator(_require_integer)]
Name = Annotated[str, StringConstraints(pattern=r"^[_a-z0-9-]+$", max_length=LONGEST_NAME)]
"""Name of an area or a run: a part of keys on the bus, and of names in certificates."""
BRANCH_ID = re.compile(rf"[_a-z0-9-]{{1,{LONGEST_NAME}}}")
"""Id of a branch: the id of a meter holds it, and has a limit on the wire."""
BranchId = Annotated[str, StringConstraints(pattern=f"^{BRANCH_ID.pattern}$")]
