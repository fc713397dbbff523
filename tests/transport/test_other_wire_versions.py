"""A watcher on a bus where programs of another wire version speak names them; it shows nothing else of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from agents.messages.packing import WIRE_VERSION
from agents.transport.zenoh_bus import Router, TransportError
from coordinator.watch.observe.attachment import attach
from coordinator.watch.observe.run_address import RunAddress
from tests.support.speaking import speaking
from tests.support.waiting import DEADLINE_S

FORMER, LATER = WIRE_VERSION - 1, WIRE_VERSION + 1


@pytest.fixture
def show(router: Router) -> Iterator[Callable[[int], None]]:
    """Have an area of another wire version on the bus."""
    with ExitStack() as stack:
        yield lambda version: stack.enter_context(speaking(router.endpoints, version, "old", "area1"))


@pytest.mark.parametrize(("version", "upgrade"), [(FORMER, "upgrade the other side"), (LATER, "upgrade this program")])
def test_a_watcher_does_not_report_that_nobody_is_there_where_another_wire_version_is(router, show, version, upgrade):
    show(version)
    with (
        pytest.raises(TransportError, match=f"run old speaks wire version {version}, this is version .*{upgrade}"),
        attach(RunAddress(router.endpoints, None, DEADLINE_S)),
    ):
        pass


def test_a_watcher_of_a_named_run_names_its_areas_of_another_wire_version(router, show):
    show(FORMER)
    with attach(RunAddress(router.endpoints, "old", DEADLINE_S)) as look:
        looks = (look(0.05) for _ in range(4000))
        seen = next(found for watcher in looks if (found := watcher.look(0.0).other_versions))
    assert seen == (f"area area1 speaks wire version {FORMER}, this is version {WIRE_VERSION}: upgrade the other side",)
