"""Registers of a real Modbus TCP server, in this process."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Callable

import pytest
from pymodbus.exceptions import ModbusIOException
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from coordinator.field.gateway.sources.modbus import ModbusSettings, ModbusSource

pytestmark = pytest.mark.slow
SILENT_S = 2.0  # after which a device has not answered; one that does, in this process, is faster on any machine


@contextlib.asynccontextmanager
async def device(port: int) -> AsyncIterator[None]:
    """Device 1: registers 0 int16 -5, 1-2 float32 12.5, 3-6 float64 nan, and after a gap 10 uint16 65535."""
    registers = [
        SimData(0, values=-5, datatype=DataType.INT16),
        SimData(1, values=12.5, datatype=DataType.FLOAT32),
        SimData(3, values=float("nan"), datatype=DataType.FLOAT64),
        SimData(10, values=65535, datatype=DataType.UINT16),
    ]
    found = ModbusTcpServer(SimDevice(1, registers), address=("127.0.0.1", port))
    await found.serve_forever(background=True)
    try:
        yield
    finally:
        await found.shutdown()


def make_source(port: int, *addresses: str, timeout_s: float = 60.0) -> ModbusSource:
    return ModbusSource(ModbusSettings(host="127.0.0.1", port=port, period_s=0.02, timeout_s=timeout_s), addresses)


def test_registers_are_read_again_and_again(free_port: int, recorder, reading, run) -> None:
    addresses = ("holding:0:int16", "holding:1:float32", "holding:3:float64", "holding:10")
    wrong = "holding:7:uint16"

    async def test() -> None:
        async with device(free_port), reading(make_source(free_port, *addresses, wrong), recorder):
            await recorder.wait_until(lambda: len(recorder.values_of("holding:10")) >= 2)

    run(test())
    assert recorder.values_of(addresses[0])[:2] == [-5, -5]
    assert recorder.values_of(addresses[1])[:2] == [12.5, 12.5]
    assert recorder.values_of(addresses[2])[0] != recorder.values_of(addresses[2])[0]
    assert recorder.values_of(addresses[3])[:2] == [65535, 65535]
    assert recorder.values_of(wrong) == []
    assert {reason for reason, _ in recorder.rejected} == {"rejected by the device"}
    assert all(wrong in detail for _, detail in recorder.rejected)


def test_a_device_that_goes_is_an_error(free_port: int, error_of_losing, run) -> None:
    async def test() -> None:
        assert await error_of_losing(device(free_port), make_source(free_port, "holding:0:int16")) is not None

    run(test())


@contextlib.asynccontextmanager
async def devices(answer: Callable[[int, int], list[int] | None]) -> AsyncIterator[int]:
    """A Modbus gateway in the fewest bytes; its port. ``answer``: device, count -> registers, None: silence."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                transaction, _, length, device = struct.unpack(">HHHB", await reader.readexactly(7))
                function, _, count = struct.unpack(">BHH", await reader.readexactly(length - 1))
                if (words := answer(device, count)) is not None:
                    body = struct.pack(f">BB{len(words)}H", function, 2 * len(words), *words)
                    writer.write(struct.pack(">HHHB", transaction, 0, len(body) + 1, device) + body)
        writer.close()

    found = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with found:
        yield found.sockets[0].getsockname()[1]


def test_a_silent_device_takes_no_reading_of_those_behind_the_same_gateway(recorder, reading, run) -> None:
    async def test() -> None:
        async with devices(lambda device, count: None if device == 2 else [device] * count) as port:
            source = make_source(port, "1/holding:0", "2/holding:0", "3/holding:0", timeout_s=SILENT_S)
            async with reading(source, recorder) as task:
                await recorder.wait_until(
                    lambda: len(recorder.rejected) >= 2 and len(recorder.values_of("3/holding:0")) > 1
                )
                assert not task.done()

    run(test())
    assert set(recorder.values_of("1/holding:0")) == {1}
    assert set(recorder.values_of("3/holding:0")) == {3}
    assert {reason for reason, _ in recorder.rejected} == {"no answer"}
    assert all("device 2" in detail for _, detail in recorder.rejected)


def test_a_device_that_answers_again_is_read_again(recorder, reading, run) -> None:
    silent = {2}

    async def test() -> None:
        async with (
            devices(lambda device, count: None if device in silent else [device] * count) as port,
            reading(make_source(port, "1/holding:0", "2/holding:0", timeout_s=SILENT_S), recorder),
        ):
            await recorder.wait_until(lambda: bool(recorder.rejected))
            silent.clear()
            await recorder.wait_until(lambda: bool(recorder.values_of("2/holding:0")))

    run(test())


def test_where_no_device_answers_the_link_has_failed(recorder, run) -> None:
    async def test() -> None:
        async with devices(lambda device, count: None) as port:
            await make_source(port, "1/holding:0", "2/holding:0", timeout_s=0.1).read(recorder)

    with pytest.raises(ModbusIOException, match="No response"):
        run(test())


def test_an_answer_of_too_few_registers_is_no_reading_and_takes_none(recorder, reading, run) -> None:
    async def test() -> None:
        async with devices(lambda device, count: [7] * (count - (device == 2))) as port:
            source = make_source(port, "1/holding:0", "2/holding:0", "2/holding:4:float32", "3/holding:0")
            async with reading(source, recorder):
                await recorder.wait_until(lambda: len(recorder.values_of("3/holding:0")) > 1)

    run(test())
    assert recorder.values_of("2/holding:0") == recorder.values_of("2/holding:4:float32") == []
    assert {reason for reason, _ in recorder.rejected} == {"rejected by the device"}
    assert "address 2/holding:4:float32: 1 registers in place of 2" in {detail for _, detail in recorder.rejected}


@pytest.mark.parametrize("address", ["256/holding:0", "holding:65536", "holding:65535:float32", "input:65533:int64"])
def test_an_address_that_no_device_can_have_is_named(address: str) -> None:
    assert "holding:100:float32" in ModbusSource.find_address_problem(address)
    assert ModbusSource.find_address_problem("255/holding:65534:float32") == ""


def test_nobody_there_is_an_error(free_port: int, recorder, run) -> None:
    with pytest.raises(OSError, match="no Modbus device"):
        run(make_source(free_port, "holding:0").read(recorder))


def test_registers_without_a_gap_are_one_question() -> None:
    source = make_source(
        1, "holding:3:float32", "holding:0", "holding:1:float32", "input:5", "holding:9", "2/holding:5:int64"
    )
    blocks = [[register.address for register in block] for block in source.blocks]
    assert blocks == [
        ["holding:0", "holding:1:float32", "holding:3:float32"],
        ["holding:9"],
        ["input:5"],
        ["2/holding:5:int64"],
    ]


def test_a_block_ends_where_the_furthest_of_overlapping_addresses_ends(recorder, reading, run) -> None:
    addresses = ("holding:0:float64", "holding:1:uint16", "holding:3:uint16")
    words = [*struct.unpack(">4H", struct.pack(">d", 12.5))]
    counts = []

    def answer(device: int, count: int) -> list[int]:
        counts.append(count)
        return words[:count]

    async def test() -> None:
        async with devices(answer) as port, reading(make_source(port, *addresses), recorder) as task:
            await recorder.wait_until(lambda: task.done() or bool(recorder.values_of(addresses[-1])))

    run(test())
    assert set(counts) == {4}
    assert [recorder.values_of(address)[0] for address in addresses] == [12.5, words[1], words[3]]
    assert recorder.rejected == []
