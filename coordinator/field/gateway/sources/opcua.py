"""Source ``opcua``: nodes of an OPC UA server. Needs asyncua, extra ``opcua``."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Any, Self

from asyncua import ua
from asyncua.client.client import Client
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.uaerrors import UaError
from pydantic import Field, model_validator

from coordinator.field.gateway.interface import Emit, MapPath, Source
from dsse_core.files.bounded_file import read_text
from dsse_core.files.strict_table import Table

NOT_THERE, DROPPED = "unknown to the server", "dropped"
CHECK_S = 1.0  # between two checks of the connection to the server
WAITING = 100  # values of a node that the server queues for one message
SAMPLING_MS = 50.0  # interval at which the server samples a node
OVERFLOW = 0x480  # of a status: the server had no room for values before this one
NO_FILTERS = {StatusCodes.BadMonitoredItemFilterUnsupported, StatusCodes.BadFilterNotAllowed}


class OpcUaSettings(Table):
    """Keys of ``[source]``. ``interval_s``: of messages with changes. ``security``: as asyncua writes it, e.g.
    ``Basic256Sha256,SignAndEncrypt,cert.der,key.pem``.
    """

    url: Annotated[str, Field(pattern=r"^opc\.tcp://")]
    interval_s: Annotated[float, Field(ge=0.01, le=3600.0)] = 0.5
    timeout_s: Annotated[float, Field(ge=0.1, le=3600.0)] = 10.0
    username: str | None = None
    password_file: MapPath | None = None
    security: str | None = None

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        if self.password_file and not self.username:
            raise ValueError("password_file needs username")
        return self


class OpcUaSource(Source):
    """Reads nodes; an address is the id of a node, ``ns=2;s=Feeder1.P``. The server sends changes of the value, of its
    status or of its source time. Only a reading of status ``Good`` is valid.
    """

    Settings = OpcUaSettings
    settings: OpcUaSettings

    @classmethod
    def find_address_problem(cls, address: str) -> str:
        try:
            ua.NodeId.from_string(address)
        except UaError:
            return "the id of a node, such as ns=2;s=Feeder1.P or ns=2;i=1001"
        return ""

    async def read(self, emit: Emit) -> None:
        settings = self.settings
        client = Client(settings.url, timeout=settings.timeout_s)
        if settings.username:
            client.set_user(settings.username)
            client.set_password(read_text(settings.password_file).strip() if settings.password_file else "")
        if settings.security:
            await client.set_security_string(settings.security)
        async with client:
            nodes: dict[Any, str] = {client.get_node(address): address for address in self.addresses}
            handler = SubscriptionHandler(nodes, emit)
            subscription = await client.create_subscription(1000 * settings.interval_s, handler)
            for node, status in (await _subscribe(subscription, list(nodes))).items():
                emit.reject(NOT_THERE, f"address {nodes[node]}: {status.name}")
            while True:
                await asyncio.sleep(CHECK_S)
                await client.check_connection()


async def _subscribe(subscription: Any, nodes: Sequence[Any]) -> dict[Any, Any]:
    """Subscribe to ``nodes``; returns node -> status of those that the server refuses.

    By default a server sends only values that differ from the last. The filter asks it to send equal values with a new
    time as well. A server that does not support the filter is subscribed to without it.
    """
    by_time = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
    rejected = await _monitor(subscription, nodes, by_time, first=0)
    without_filters = [node for node, status in rejected.items() if status.value in NO_FILTERS]
    for node in without_filters:
        del rejected[node]
    if without_filters:
        rejected |= await _monitor(subscription, without_filters, None, first=len(nodes))
    return rejected


async def _monitor(subscription: Any, nodes: Sequence[Any], only: Any, first: int) -> dict[Any, Any]:
    """Node -> status of those of ``nodes`` that cannot be monitored; client handles count from ``first + 1``."""
    requests = [
        ua.MonitoredItemCreateRequest(
            ItemToMonitor=ua.ReadValueId(NodeId=node.nodeid, AttributeId=AttributeIds.Value),
            MonitoringMode=ua.MonitoringMode.Reporting,
            RequestedParameters=ua.MonitoringParameters(
                ClientHandle=number, SamplingInterval=SAMPLING_MS, Filter=only, QueueSize=WAITING
            ),
        )
        for number, node in enumerate(nodes, start=first + 1)
    ]
    results = await subscription.create_monitored_items(requests) if requests else []
    return {node: found for node, found in zip(nodes, results, strict=True) if isinstance(found, ua.StatusCode)}


class SubscriptionHandler:
    """Receiver of the server's notifications."""

    def __init__(self, nodes: dict[Any, str], emit: Emit) -> None:
        self.nodes = nodes
        self.emit = emit

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        found = data.monitored_item.Value
        stamp: datetime | None = found.SourceTimestamp or found.ServerTimestamp
        time = None if stamp is None else (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
        valid = found.StatusCode is None or found.StatusCode.is_good()
        if not valid and value is None:
            value = 0.0  # a bad value need not be there
        if found.StatusCode is not None and found.StatusCode.value & OVERFLOW == OVERFLOW:
            self.emit.reject(DROPPED, f"address {self.nodes[node]}: the server had no room for values before this one")
        self.emit(self.nodes[node], value, time, valid=valid)
