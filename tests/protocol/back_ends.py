"""All back ends of the exact exchange, whatever the size of an area."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dsse_core.linear import choose

BACK_ENDS = ("sparse", "radial", "dense")


@contextmanager
def back_end(name: str) -> Iterator[None]:
    """Have all areas use the tree wherever there is one, or dense matrices, or sparse ones."""
    assert name in BACK_ENDS
    if name == "radial":
        pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choose, "RADIAL_FROM", 0 if name == "radial" else 10**9)
        patch.setattr(choose, "DENSE_BELOW", 10**9 if name == "dense" else 0)
        yield
