"""What runs on every back end of the exact exchange."""

from collections.abc import Iterator

import pytest
from back_ends import BACK_ENDS, back_end


@pytest.fixture(scope="module", params=BACK_ENDS)
def each_back_end(request: pytest.FixtureRequest) -> Iterator[None]:
    with back_end(request.param):
        yield
