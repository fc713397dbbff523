"""Source ``opcua``: nodes of an OPC UA server. Needs asyncua, extra ``opcua``."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from typing import Annotated, Any, Self

from asyncua import ua
from asyncua.client.client import Client
from asyncua.ua.uaerrors import UaError
from pydantic import Field, model_validator

from coordinator.gateway.interface import Emit, MapPath, Source
from dsse_core.files.bounded_file import read_text
from dsse_core.files.strict_table import Table

NOT_THERE = "unknown to the server"
CHECK_S = 1.0  # between two looks whether the server is still there
WAITING = 100  # values of a node that the server keeps for one message


class OpcUaSettings(Table):
    """Of ``[source]``. ``interval_s``: of messages with what has changed. ``security``: as asyncua writes it, e.g.
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
    """An address is the id of a node, ``ns=2;s=Feeder1.P``. The server sends what has changed, with the time of its
    source and a status; only ``Good`` is vouched for.
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
            handler = _Handler(nodes, emit)
            subscription = await client.create_subscription(1000 * settings.interval_s, handler)
            asked: list[Any] = list(nodes)
            results = await subscription.subscribe_data_change(asked, queuesize=WAITING)
            for address, result in zip(nodes.values(), results, strict=True):
                if isinstance(result, ua.StatusCode):
                    emit.refuse(NOT_THERE, f"address {address}: {result.name}")
            while True:
                await asyncio.sleep(CHECK_S)
                await client.check_connection()


class _Handler:
    """Gets what the server sends."""

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
        self.emit(self.nodes[node], value, time, valid=valid)
