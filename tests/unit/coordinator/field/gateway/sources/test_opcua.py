"""Nodes of a real OPC UA server, in this process."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import Server, ua
from asyncua.server.monitored_item_service import MonitoredItemService

from coordinator.field.gateway.sources.opcua import OpcUaSettings, OpcUaSource, SubscriptionHandler

pytestmark = pytest.mark.slow


@contextlib.asynccontextmanager
async def server(port: int) -> AsyncIterator[dict[str, Any]]:
    """A server with nodes u and p; name -> node."""
    found = Server()
    await found.init()
    found.set_endpoint(f"opc.tcp://127.0.0.1:{port}/")
    found.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await found.register_namespace("test")
    nodes = {
        name: await found.nodes.objects.add_variable(ua.NodeId(name, space), name, value)
        for name, value in (("u", 12.6), ("p", 7.0), ("text", "on"))
    }
    async with found:
        yield nodes


def make_source(port: int, *names: str) -> OpcUaSource:
    settings = OpcUaSettings(url=f"opc.tcp://127.0.0.1:{port}/", interval_s=0.02, timeout_s=60.0)
    return OpcUaSource(settings, [f"ns=2;s={name}" for name in names])


def test_values_come_with_their_time_and_status(free_port: int, recorder, reading, run) -> None:
    async def test() -> None:
        source = make_source(free_port, "u", "p", "text", "none")
        async with server(free_port) as nodes, reading(source, recorder):
            await recorder.wait_until(lambda: len(recorder.readings) == 3)
            at = datetime(2027, 1, 15, 8, tzinfo=UTC)
            value = ua.DataValue(ua.Variant(12.7), SourceTimestamp=at.replace(tzinfo=None))
            await nodes["u"].write_value(value)
            await recorder.wait_until(lambda: 12.7 in recorder.values_of("ns=2;s=u"))
            bad = ua.DataValue(ua.Variant(float("nan")), ua.StatusCode(ua.StatusCodes.BadSensorFailure))
            await nodes["p"].write_value(bad)
            await recorder.wait_until(lambda: len(recorder.values_of("ns=2;s=p")) == 2)

    run(test())
    assert ("ns=2;s=u", 12.7, 1.8e9, True, None) in recorder.readings
    assert [reading[3] for reading in recorder.readings if reading[0] == "ns=2;s=p"] == [True, False]
    assert recorder.values_of("ns=2;s=text") == ["on"]
    assert len(recorder.rejected) == 1
    assert recorder.rejected[0][0] == "unknown to the server"
    assert "ns=2;s=none" in recorder.rejected[0][1]


def test_a_value_that_is_read_again_and_has_not_changed_is_a_reading(free_port: int, recorder, reading, run) -> None:
    times = [datetime(2027, 1, 15, 8, 0, second, tzinfo=UTC) for second in range(3)]

    async def test() -> None:
        async with server(free_port) as nodes, reading(make_source(free_port, "u"), recorder):
            await recorder.wait_until(lambda: len(recorder.readings) == 1)
            for k, at in enumerate(times, start=2):
                value = ua.DataValue(ua.Variant(12.6), SourceTimestamp=at.replace(tzinfo=None))
                await nodes["u"].write_value(value)
                await recorder.wait_until(lambda k=k: len(recorder.readings) == k)

    run(test())
    assert [reading[2] for reading in recorder.readings[1:]] == [at.timestamp() for at in times]


def test_a_server_that_cannot_report_new_times_reports_new_values(
    free_port: int, recorder, reading, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = MonitoredItemService._create_data_change_monitored_item

    async def reject_filters(self: Any, params: Any) -> Any:
        if not isinstance(params.RequestedParameters.Filter, ua.DataChangeFilter):
            return await create(self, params)
        unsupported = ua.StatusCode(ua.StatusCodes.BadMonitoredItemFilterUnsupported)
        return ua.MonitoredItemCreateResult(StatusCode=unsupported)

    monkeypatch.setattr(MonitoredItemService, "_create_data_change_monitored_item", reject_filters)

    async def test() -> None:
        async with server(free_port) as nodes, reading(make_source(free_port, "u", "none"), recorder):
            await recorder.wait_until(lambda: len(recorder.readings) == 1)
            await nodes["u"].write_value(12.7)
            await recorder.wait_until(lambda: 12.7 in recorder.values_of("ns=2;s=u"))

    run(test())
    assert [reason for reason, _ in recorder.rejected] == ["unknown to the server"]


def test_values_that_a_server_had_no_room_for_are_counted(recorder) -> None:
    item = ua.MonitoredItemNotification(Value=ua.DataValue(ua.Variant(1.0), ua.StatusCode(0x480)))
    node = object()
    handler = SubscriptionHandler({node: "ns=2;s=u"}, recorder)
    handler.datachange_notification(node, 1.0, SimpleNamespace(monitored_item=item))
    assert recorder.values_of("ns=2;s=u") == [1.0]
    assert recorder.readings[0][3]
    assert [reason for reason, _ in recorder.rejected] == ["dropped"]


def test_a_server_that_goes_is_an_error(free_port: int, error_of_losing, run) -> None:
    async def test() -> None:
        assert await error_of_losing(server(free_port), make_source(free_port, "u")) is not None

    run(test())


def test_nobody_there_is_an_error(free_port: int, recorder, run) -> None:
    with pytest.raises(ConnectionRefusedError):
        run(make_source(free_port, "u").read(recorder))
