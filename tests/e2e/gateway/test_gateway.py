"""Readings of the field reach areas as processes, whatever else comes, and results go back."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import aiomqtt
import pytest

from tests.support.dsse_command import free_port
from tests.support.mqtt_broker import broker
from tests.support.repeating import repeating
from tests.support.waiting import DEADLINE_S, wait_until

PERIOD_S = 0.1


def writing(path: Path, values: dict[str, float]) -> AbstractContextManager[None]:
    """A CSV file, to which a line for each meter is appended again and again during the block."""
    path.write_text("time,address,value\n")

    def write() -> None:
        now = time.time()
        append(path, [f"{now},{meter},{value}" for meter, value in values.items()])

    return repeating(write, PERIOD_S)


def append(path: Path, lines: list[str]) -> None:
    """In one piece: two writers do not mix their lines."""
    with path.open("ab", buffering=0) as file:
        file.write(("\n".join(lines) + "\n").encode())


def test_a_flood_of_bad_readings_is_counted_and_nothing_else_is_lost(live, status_of) -> None:
    readings = live.folder / "r.csv"
    map_file = live.write_map("north", '[source]\nkind = "csv"\npath = "r.csv"\npoll_s = 0.02\n', str)
    with writing(readings, live.values):
        live.processes.start("gateway", "gateway", map_file, "--status-file", "status.json")
        live.wait_for("good")
        now, ahead = time.time(), time.time() + 7200
        bad = [f"{now},vm@1,nan", f"{now},vm@4,abc", f"{now},nowhere,1", f"{ahead},vm@1,1.1", f"{now},vm@1,1000", "x"]
        for _ in range(10):
            append(readings, bad * 1000 + [f"{now - 3600},vm@1,1.3"] * 4000)
        reasons = ("not finite", "bad type", "unknown address", "ahead of time", "out of range", "malformed")
        wanted = {**dict.fromkeys(reasons, 10_000), "older than the last": 40_000}

        def is_counted() -> bool:
            rejected = status_of("status.json").get("rejected", {})
            return all(rejected.get(reason, {}).get("count") == count for reason, count in wanted.items())

        wait_until(is_counted)
        assert status_of("status.json")["rejected"]["bad type"]["addresses"] == {"vm@4": 10_000}
        states = {name: state.header.sequence for name, state in live.states.items()}
        wait_until(lambda: all(state.header.sequence > states[name] for name, state in live.states.items()))
        live.wait_for("good")
        assert all(abs(vm - 1) < 0.2 for state in live.states.values() for vm in state.vm)
    code = live.processes.end("gateway", signal.SIGINT)
    assert code == 0
    counts = status_of("status.json")
    rejected_readings = sum(found["count"] for reason, found in counts["rejected"].items() if reason != "malformed")
    assert counts["received"] == counts["used"] + counts["superseded"] + rejected_readings
    output = live.processes.read_log("gateway")
    assert "not used, bad type (1000 so far): address vm@4" in output
    assert "Traceback" not in output
    assert output.count("\n") < 100


def test_a_gateway_that_is_killed_is_missed_and_another_goes_on(live) -> None:
    source = '[source]\nkind = "csv"\npath = "r.csv"\npoll_s = 0.02\n'
    first, second = live.write_map("north", source, str), live.write_map("south", source, str)
    with writing(live.folder / "r.csv", live.values):
        live.processes.start("gateway", "gateway", first)
        live.wait_for("good")
        live.processes.end("gateway", signal.SIGKILL)
        live.wait_for("stale")
        live.processes.start("gateway", "gateway", second)
        live.wait_for("good")
    assert live.processes.end("gateway") == 0


def test_of_two_gateways_under_one_name_the_older_ends(live) -> None:
    map_file = live.write_map("north", '[source]\nkind = "csv"\npath = "r.csv"\n', str)
    live.processes.start("older", "gateway", map_file)
    wait_until(lambda: "gateway north of run live" in live.processes.read_log("older"))
    live.processes.start("newer", "gateway", map_file)
    assert live.processes.processes["older"].wait(DEADLINE_S) == 3
    assert "two processes run as gateway north of run live at once" in live.processes.read_log("older")
    assert live.processes.end("newer") == 0
    assert "r.csv" in live.processes.read_log("newer")


def areas_in(results: Path) -> set[str]:
    """Of which results are there; the last line may be in the writing."""
    lines = results.read_text().splitlines(keepends=True) if results.exists() else []
    return {json.loads(line)["area"] for line in lines if line.endswith("\n")}


async def publish(port: int, values: dict[str, float], ended: asyncio.Event) -> None:
    async with aiomqtt.Client("127.0.0.1", port, timeout=DEADLINE_S) as client:
        while not ended.is_set():
            for meter, value in values.items():
                payload = json.dumps({"value": value, "time": time.time()})
                await client.publish(f"field/{meter}", payload, qos=0)
            await asyncio.sleep(PERIOD_S)


async def until(holds: Callable[[], bool]) -> None:
    await asyncio.to_thread(wait_until, holds)


def test_values_in_a_broker_become_results_in_it_also_after_it_was_away(live, status_of) -> None:
    port = free_port()
    address = f'host = "127.0.0.1"\nport = {port}\n'
    results = f'[[results]]\nkind = "mqtt"\n{address}\n[[results]]\nkind = "jsonl"\npath = "results.jsonl"\n'
    map_file = live.write_map("north", f'[source]\nkind = "mqtt"\n{address}', lambda m: f"field/{m}", results)

    async def test() -> list[dict[str, object]]:
        ended, found = asyncio.Event(), []
        async with contextlib.AsyncExitStack() as stack:
            await stack.enter_async_context(broker(port))
            task = asyncio.create_task(publish(port, live.values, ended))
            live.processes.start("gateway", "gateway", map_file, "--status-file", "status.json")
            await asyncio.to_thread(live.wait_for, "good")
            ended.set()
            await task
        await until(
            lambda: [bool(link["error"]) for link in status_of("status.json").get("links", [])[:2]] == [True] * 2
        )
        ended = asyncio.Event()
        async with broker(port):
            task = asyncio.create_task(publish(port, live.values, ended))
            async with aiomqtt.Client("127.0.0.1", port, timeout=DEADLINE_S) as client:
                await client.subscribe("dsse/live/+/state")
                async for message in client.messages:
                    found.append(json.loads(message.payload))
                    if {result["area"] for result in found if result["quality"] == "good"} == {"area1", "area2"}:
                        break
            ended.set()
            await task
        return found

    async def with_deadline() -> list[dict[str, object]]:
        async with asyncio.timeout(3 * DEADLINE_S):
            return await test()

    found = asyncio.run(with_deadline())
    bus = next(row for row in found[-1]["buses"])
    base_kv = live.scenario.network.bus(bus["bus"]).base_kv
    assert bus["vm_kv"] == pytest.approx(base_kv * bus["vm_pu"])
    assert found[-1]["branches"]
    assert live.processes.end("gateway") == 0
    assert areas_in(live.folder / "results.jsonl") == {"area1", "area2"}
    output = live.processes.read_log("gateway")
    assert "source works again" in output
    assert "Traceback" not in output


@pytest.mark.parametrize("live", ["keys"], indirect=True)
def test_with_keys_a_gateway_sends_for_its_own_areas_and_gets_their_results(live) -> None:
    source = '[source]\nkind = "csv"\npath = "r.csv"\npoll_s = 0.02\n'
    results = '[[results]]\nkind = "jsonl"\npath = "results.jsonl"\n'
    north = live.write_map("north", source, str, results)
    with writing(live.folder / "r.csv", live.values):
        live.processes.start("north", "gateway", north, *live.keys)
        live.wait_for("good")
        written = live.folder / "results.jsonl"
        wait_until(lambda: areas_in(written) == {"area1", "area2"})
    assert live.processes.end("north") == 0
    assert areas_in(written) == {"area1", "area2"}
    south = live.write_map("south", source, str)
    live.processes.start("south", "gateway", south, *live.keys)
    assert live.processes.processes["south"].wait(DEADLINE_S) == 2
    assert "is not that of gateway 'south'" in live.processes.read_log("south")
    west = live.folder / "west.toml"
    west.write_text(north.read_text().replace('name = "north"', 'name = "west"'))
    live.processes.start("west", "gateway", west, *live.keys)
    assert live.processes.processes["west"].wait(DEADLINE_S) == 2
