"""A router in the open, for tests on one bus."""

from collections.abc import Iterator

import pytest

from agents.transport.zenoh_bus import Router


@pytest.fixture
def router() -> Iterator[Router]:
    with Router.listen(["tcp/127.0.0.1:0"]) as router:
        yield router
