"""Back ends of the exact exchange: each of them, or one after the other."""

from collections.abc import Iterator

import pytest

from tests.support.back_ends import BACK_ENDS, back_end

IN_TURN = "in turn"


@pytest.fixture(
    scope="module",
    params=[name if name == "dense" else pytest.param(name, marks=pytest.mark.long) for name in BACK_ENDS],
)
def each_back_end(request: pytest.FixtureRequest) -> Iterator[None]:
    """Small areas are dense; the same claim on the other back ends is ``long``."""
    with back_end(request.param):
        yield


@pytest.fixture
def back_end_in_turn(request: pytest.FixtureRequest, random_seed: int) -> Iterator[None]:
    """Random cases are for what holds on all back ends; that these agree is ``test_exchange_back_ends``."""
    with back_end(BACK_ENDS[random_seed % len(BACK_ENDS)] if request.param == IN_TURN else request.param):
        yield


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """``back_end_in_turn``: with ``--thorough`` every case runs on each of them."""
    if "back_end_in_turn" in metafunc.fixturenames:
        params = BACK_ENDS if metafunc.config.getoption("--thorough") else [IN_TURN]
        metafunc.parametrize("back_end_in_turn", params, indirect=True)
