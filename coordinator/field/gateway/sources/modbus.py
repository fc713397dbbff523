"""Source ``modbus``: registers of a Modbus TCP device, read again and again. Needs pymodbus, extra ``modbus``."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Annotated, Any, Literal

from pydantic import Field
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from coordinator.field.gateway.interface import Emit, Source
from dsse_core.files.strict_table import Table

REJECTED, SILENT = "rejected by the device", "no answer"
ADDRESS = re.compile(r"(?:(?P<device>\d{1,3})/)?(?P<table>holding|input):(?P<register>\d{1,5})(?::(?P<type>\w+))?")
MOST_REGISTERS = 120  # of one request; the protocol allows 125
LARGEST_DEVICE, REGISTERS = 255, 2**16
LONGEST_SILENCE_S = 10.0  # between two requests to a device that does not answer: each delays the other devices
TYPES = {
    "int16": AsyncModbusTcpClient.DATATYPE.INT16,
    "uint16": AsyncModbusTcpClient.DATATYPE.UINT16,
    "int32": AsyncModbusTcpClient.DATATYPE.INT32,
    "uint32": AsyncModbusTcpClient.DATATYPE.UINT32,
    "int64": AsyncModbusTcpClient.DATATYPE.INT64,
    "uint64": AsyncModbusTcpClient.DATATYPE.UINT64,
    "float32": AsyncModbusTcpClient.DATATYPE.FLOAT32,
    "float64": AsyncModbusTcpClient.DATATYPE.FLOAT64,
}


class ModbusSettings(Table):
    """Keys of ``[source]``. ``period_s``: from one reading of all registers to the next. ``words``: order of the 16-bit
    words of a longer number.
    """

    host: str
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    device: Annotated[int, Field(ge=0, le=255)] = 1
    period_s: Annotated[float, Field(ge=0.01, le=3600.0)] = 1.0
    timeout_s: Annotated[float, Field(ge=0.1, le=60.0)] = 3.0
    words: Literal["big", "little"] = "big"


@dataclass(frozen=True, slots=True, order=True)
class _Register:
    """Place of an ``address``: ``count`` registers of 16 bits from ``first`` on."""

    device: int
    table: str
    first: int
    count: int
    type: str
    address: str

    @property
    def place(self) -> tuple[int, str]:
        return self.device, self.table

    @property
    def end(self) -> int:
        """Number of the register behind the last."""
        return self.first + self.count


@dataclass(frozen=True, slots=True)
class _Silence:
    """Pause of a device that has not answered: no request until ``until`` (loop time, s); ``pause_s`` grows."""

    until: float
    pause_s: float

    @classmethod
    def after(cls, last: _Silence | None, now: float, settings: ModbusSettings) -> _Silence:
        pause_s = min(2 * last.pause_s, LONGEST_SILENCE_S) if last else settings.period_s
        return cls(now + pause_s, pause_s)


class ModbusSource(Source):
    """An address is ``TABLE:REGISTER:TYPE`` or ``DEVICE/TABLE:REGISTER:TYPE``, the register counted from 0: such as
    ``holding:100:float32``. The time of a reading is that of the answer.
    """

    Settings = ModbusSettings
    settings: ModbusSettings

    def __init__(self, settings: Any, addresses: Sequence[str]) -> None:
        super().__init__(settings, addresses)
        self.blocks = list(_join(sorted(_parse(address, settings.device) for address in addresses)))

    @classmethod
    def find_address_problem(cls, address: str) -> str:
        found = ADDRESS.fullmatch(address)
        if found and (found["type"] or "uint16") in TYPES:
            register = _parse(address, 0)
            if register.device <= LARGEST_DEVICE and register.end <= REGISTERS:
                return ""
        return f"TABLE:REGISTER:TYPE, such as holding:100:float32 or 3/input:0:int16; types: {', '.join(TYPES)}"

    async def read(self, emit: Emit) -> None:
        settings = self.settings
        client = AsyncModbusTcpClient(
            settings.host, port=settings.port, timeout=settings.timeout_s, retries=0, reconnect_delay=0
        )
        devices = {device: list(blocks) for device, blocks in groupby(self.blocks, lambda block: block[0].device)}
        silent: dict[int, _Silence] = {}
        try:
            loop = asyncio.get_running_loop()
            due = loop.time()
            while True:
                for device, blocks in devices.items():
                    if device in silent and loop.time() < silent[device].until:
                        continue
                    if not client.connected and not await client.connect():
                        raise ConnectionError(f"no Modbus device at {settings.host}:{settings.port}")
                    try:
                        for block in blocks:
                            await self._read_block(client, block, emit)
                        silent.pop(device, None)
                    except ModbusException as error:
                        silent[device] = _Silence.after(silent.get(device), loop.time(), settings)
                        if silent.keys() == devices.keys():
                            raise
                        emit.reject(SILENT, f"device {device}: {error}")
                due = max(due + settings.period_s, loop.time())
                await asyncio.sleep(due - loop.time())
        finally:
            client.close()

    async def _read_block(self, client: AsyncModbusTcpClient, block: Sequence[_Register], emit: Emit) -> None:
        """Read adjacent registers with one request; where the device rejects it, read each register by itself."""
        first = block[0]
        read = client.read_holding_registers if first.table == "holding" else client.read_input_registers
        count = max(register.end for register in block) - first.first  # addresses may overlap
        answer = await read(first.first, count=count, device_id=first.device)
        if answer.isError() or len(answer.registers) != count:
            if len(block) > 1:
                for register in block:
                    await self._read_block(client, [register], emit)
            else:
                found = answer if answer.isError() else f"{len(answer.registers)} registers in place of {count}"
                emit.reject(REJECTED, f"address {first.address}: {found}")
            return
        for register in block:
            start = register.first - first.first
            words = answer.registers[start : start + register.count]
            emit(register.address, client.convert_from_registers(words, TYPES[register.type], self.settings.words))


def _parse(address: str, device: int) -> _Register:
    found = ADDRESS.fullmatch(address)
    assert found, address  # the map was checked
    kind = found["type"] or "uint16"
    count = TYPES[kind].value[1]
    return _Register(int(found["device"] or device), found["table"], int(found["register"]), count, kind, address)


def _join(registers: Sequence[_Register]) -> Iterator[list[_Register]]:
    """Blocks of sorted registers without gaps, since a device may have no register between two of the map."""
    block: list[_Register] = []
    end = 0  # of the block: the furthest of its registers, as addresses may overlap
    for register in registers:
        if block and (
            register.place != block[0].place or register.first > end or register.end - block[0].first > MOST_REGISTERS
        ):
            yield block
            block = []
        end = max(end, register.end) if block else register.end
        block.append(register)
    if block:
        yield block
