"""The field of a feeder in a process of its own: an MQTT broker, an OPC UA server, a Modbus device, and the meters that
publish there, each at its interval.

``python -m tests.support.field.field ORDERS.json``: which meters there are and where (``Orders`` of ``feeder.py``).
Each line on standard input replaces the faults, as JSON: ``{"sign": [ids], "frozen": [ids]}``; it is answered by a line
on standard output.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import aiomqtt
from amqtt.broker import Broker
from asyncua import Server, ua
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from tests.support.field.field_meters import FieldMeter

STEP_S = 0.02
WRITE_REGISTERS = 16  # function code
FLOAT32 = AsyncModbusTcpClient.DATATYPE.FLOAT32


@dataclass
class Field:
    """``write``: way -> how a reading gets out; ``sign``, ``frozen``: meters with a fault."""

    meters: Sequence[FieldMeter]
    write: Mapping[str, Any]
    sign: frozenset[str] = frozenset()
    frozen: frozenset[str] = frozenset()
    draws: random.Random = field(default_factory=lambda: random.Random(1))

    async def read(self) -> None:
        """All meters, for ever; a frozen one shows its last reading and says when that was."""
        while True:
            now = time.monotonic()
            for meter in self.meters:
                if now >= meter.due and meter.id not in self.frozen:
                    meter.due = max(meter.due + meter.period_s, now)
                    value = meter.value + meter.sigma * self.draws.gauss(0.0, 1.0)
                    await self.write[meter.by](meter.address, -value if meter.id in self.sign else value)
            await asyncio.sleep(STEP_S)

    async def obey(self) -> None:
        """What comes on standard input, until its end."""
        loop = asyncio.get_running_loop()
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            faults = json.loads(line)
            self.sign, self.frozen = frozenset(faults["sign"]), frozenset(faults["frozen"])
            print("done", flush=True)


@contextlib.asynccontextmanager
async def broker(port: int) -> Any:
    """A broker; how to publish a reading with its time."""
    everybody = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    made = Broker({"listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}}, "plugins": everybody})
    await made.start()
    try:
        async with aiomqtt.Client("127.0.0.1", port, timeout=60.0) as client:

            async def write(topic: str, value: float) -> None:
                await client.publish(topic, json.dumps({"value": value, "time": time.time()}), retain=True)

            yield write
    finally:
        await made.shutdown()


@contextlib.asynccontextmanager
async def opcua_server(port: int, addresses: Sequence[str]) -> Any:
    """A server with a node for each address ``ns=2;s=NAME``; how to write one with its time."""
    made = Server()
    await made.init()
    made.set_endpoint(f"opc.tcp://127.0.0.1:{port}/")
    made.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = await made.register_namespace("field")
    names = {address: address.partition(";s=")[2] for address in addresses}
    nodes = {
        address: await made.nodes.objects.add_variable(ua.NodeId(name, space), ua.QualifiedName(name, space), 0.0)
        for address, name in names.items()
    }
    unread = ua.DataValue(ua.Variant(0.0), ua.StatusCode(ua.StatusCodes.BadWaitingForInitialData))
    for node in nodes.values():
        await node.write_value(unread)

    async def write(address: str, value: float) -> None:
        now = datetime.now(UTC).replace(tzinfo=None)
        await nodes[address].write_value(ua.DataValue(ua.Variant(value), SourceTimestamp=now))

    async with made:
        yield write


@contextlib.asynccontextmanager
async def modbus_device(port: int, addresses: Sequence[str]) -> Any:
    """A device with a float for each address ``holding:REGISTER:float32``; how to write one."""
    registers = {address: int(address.split(":")[1]) for address in addresses}
    data = [SimData(register, values=0.0, datatype=DataType.FLOAT32) for register in sorted(registers.values())]
    made = ModbusTcpServer(SimDevice(1, data or [SimData(0, values=0)]), address=("127.0.0.1", port))
    await made.serve_forever(background=True)

    async def write(address: str, value: float) -> None:
        words = AsyncModbusTcpClient.convert_to_registers(value, FLOAT32)
        await made.async_setValues(1, WRITE_REGISTERS, registers[address], words)

    try:
        yield write
    finally:
        await made.shutdown()


async def main(orders: Mapping[str, Any]) -> None:
    meters = [FieldMeter(**meter) for meter in orders["meters"]]
    there = {by: [meter.address for meter in meters if meter.by == by] for by in ("mqtt", "opcua", "modbus")}
    ports = orders["ports"]
    async with (
        broker(ports["mqtt"]) as to_broker,
        opcua_server(ports["opcua"], there["opcua"]) as to_server,
        modbus_device(ports["modbus"], there["modbus"]) as to_device,
    ):
        field = Field(meters, {"mqtt": to_broker, "opcua": to_server, "modbus": to_device})
        print("ready", flush=True)
        reading = asyncio.create_task(field.read())
        await asyncio.wait([reading, asyncio.create_task(field.obey())], return_when=asyncio.FIRST_COMPLETED)
        if reading.done():
            reading.result()
        reading.cancel()


if __name__ == "__main__":
    asyncio.run(main(json.loads(Path(sys.argv[1]).read_text())))
