"""Registers of a real Modbus TCP server, in this process."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator

import pytest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from coordinator.gateway.sources.modbus import ModbusSettings, ModbusSource

pytestmark = pytest.mark.long


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


def make_source(port: int, *addresses: str) -> ModbusSource:
    return ModbusSource(ModbusSettings(host="127.0.0.1", port=port, period_s=0.02, timeout_s=1.0), addresses)


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
    assert {reason for reason, _ in recorder.refused} == {"rejected by the device"}
    assert all(wrong in detail for _, detail in recorder.refused)


def test_a_device_that_goes_is_an_error(free_port: int, error_of_losing, run) -> None:
    async def test() -> None:
        assert await error_of_losing(device(free_port), make_source(free_port, "holding:0:int16")) is not None

    run(test())


def test_nobody_there_is_an_error(free_port: int, recorder, run) -> None:
    with pytest.raises(OSError, match="no Modbus device"):
        run(make_source(free_port, "holding:0").read(recorder))


def test_registers_without_a_gap_are_one_question(free_port: int) -> None:
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
