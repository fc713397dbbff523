"""Topics of a real broker, in this process."""

from __future__ import annotations

import asyncio
import contextlib

import aiomqtt
import pytest
from pydantic import ValidationError

import coordinator.field.gateway.broker
from coordinator.field.gateway.sources import mqtt
from coordinator.field.gateway.sources.mqtt import FairQueue, MqttSettings, MqttSource
from tests.support.mqtt_broker import broker

pytestmark = pytest.mark.slow


def make_source(port: int, *addresses: str, **options: object) -> MqttSource:
    return MqttSource(MqttSettings.model_validate({"host": "127.0.0.1", "port": port, **options}), addresses)


def test_numbers_objects_and_bad_payloads(free_port: int, recorder, reading, run) -> None:
    async def test() -> None:
        async with broker(free_port), aiomqtt.Client("127.0.0.1", free_port) as client:
            await client.publish("f/old", "5", retain=True, qos=1)
            await client.publish("f/older", '{"value": 5, "time": null}', retain=True, qos=1)
            await client.publish("f/dated", '{"value": 6, "time": 1800000000}', retain=True, qos=1)
            source = make_source(
                free_port, "f/u", "f/p#a.total", "f/p#b", "f/old", "f/older", "f/dated", topics=["f/#"]
            )
            async with reading(source, recorder):
                await recorder.wait_until(lambda: len(recorder.rejected) == 2 and bool(recorder.readings))
                for topic, payload in (
                    ("f/u", "12.6"),
                    ("f/u", "NaN"),
                    ("f/u", "abc"),
                    ("f/u", "{broken"),
                    ("f/u", b"x" * 100_000),
                    ("f/p", '{"a": {"total": 7}, "time": "2027-01-15T08:00:00Z", "valid": false, "unit": "kW"}'),
                    ("f/p", "8"),
                    ("f/stranger", "9"),
                    ("f/u", "12.7"),
                ):
                    await client.publish(topic, payload, qos=1)
                await recorder.wait_until(lambda: 12.7 in recorder.values_of("f/u"))

    run(test())
    assert recorder.readings[0] == ("f/dated", 6, 1800000000, True, None)
    assert recorder.values_of("f/u")[0] == 12.6
    assert recorder.values_of("f/u")[2:] == ["abc", 12.7]
    assert ("f/p#a.total", 7, 1.8e9, False, "kW") in recorder.readings
    assert recorder.values_of("f/stranger") == [9.0]
    assert [reason for reason, _ in recorder.rejected] == [
        "retained without a time",
        "retained without a time",
        "malformed",  # broken
        "malformed",  # too large
        "malformed",  # nothing at b
        "malformed",  # no object, twice
        "malformed",
    ]


def test_a_broker_that_goes_is_an_error(free_port: int, recorder, reading, run) -> None:
    async def test() -> None:
        async with contextlib.AsyncExitStack() as stack:
            await stack.enter_async_context(broker(free_port))
            async with reading(make_source(free_port, "u"), recorder) as task:
                async with aiomqtt.Client("127.0.0.1", free_port) as client:
                    while not recorder.readings:
                        await client.publish("u", "1", qos=1)
                await stack.aclose()
                with pytest.raises(aiomqtt.MqttError):
                    await task

    run(test())


def test_nobody_there_is_an_error(free_port: int, recorder, run) -> None:
    with pytest.raises(aiomqtt.MqttError):
        run(make_source(free_port, "u").read(recorder))


def test_a_flood_of_one_topic_takes_no_message_of_another_and_is_counted(recorder, run) -> None:
    def message(topic: str, k: int) -> aiomqtt.Message:
        return aiomqtt.Message(topic, str(k).encode(), 0, False, k, None)

    async def test() -> None:
        queue = FairQueue({"quiet", "loud"})
        queue.put_nowait(message("quiet", 1))
        for k in range(10_000):
            queue.put_nowait(message("loud", k))
        assert queue.qsize() == 1 + mqtt.MOST_OF_A_TOPIC
        found = [await queue.get() for _ in range(queue.qsize())]
        assert str(found[0].topic) == "quiet"
        assert [int(m.payload) for m in found[1:]] == list(range(10_000 - mqtt.MOST_OF_A_TOPIC, 10_000))
        assert queue.empty()
        mqtt.report_dropped(queue, recorder)

    run(test())
    assert len(recorder.rejected) == 10_000 - mqtt.MOST_OF_A_TOPIC
    assert recorder.rejected[0][0] == "dropped"


def test_a_flood_of_ever_new_topics_and_of_large_payloads_takes_no_memory(recorder, run) -> None:
    large = bytes(10 * mqtt.LARGEST_PAYLOAD)

    async def test() -> None:
        queue = FairQueue({"quiet"})
        queue.put_nowait(aiomqtt.Message("quiet", large, 0, False, 0, None))
        for k in range(10_000):
            queue.put_nowait(aiomqtt.Message(f"new/{k}", b"1", 0, False, k, None))
        assert queue.qsize() == 1 + mqtt.MOST_OF_A_TOPIC
        source = make_source(1, "quiet")
        waiting = [await queue.get() for _ in range(queue.qsize())]
        assert sum(len(m.payload) for m in waiting) < 2 * mqtt.LARGEST_PAYLOAD
        for each in waiting:
            source._take(each, recorder)
        mqtt.report_dropped(queue, recorder)

    run(test())
    assert [address for address, *_ in recorder.readings] == [f"new/{k}" for k in range(9_900, 10_000)]
    reasons = [reason for reason, _ in recorder.rejected]
    assert reasons == ["malformed", *["dropped"] * 9_900]


@pytest.mark.parametrize("topics", [["f/#/x"], ["f+/a"], [""], ["a#"], ["f/\0"]])
def test_a_topic_to_which_nobody_can_subscribe_is_named_with_the_map(topics: list[str]) -> None:
    with pytest.raises(ValidationError, match="topics"):
        make_source(1, "f/u", topics=topics)
    assert make_source(1, "f/u", topics=["#", "+", "a/+/b", "/", "a/#"]).settings.topics[0] == "#"


async def fall_silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """A broker that takes a client and its subscription, and says nothing after that."""
    with contextlib.suppress(ConnectionError):
        await reader.read(1000)
        writer.write(b"\x20\x02\x00\x00")
        asked = await reader.read(1000)
        writer.write(b"\x90\x03" + asked[2:4] + b"\x00")
        while await reader.read(1000):
            pass
    writer.close()


def test_a_broker_that_falls_silent_is_an_error(
    free_port: int, recorder, reading, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coordinator.field.gateway.broker, "KEEPALIVE_S", 1)

    async def test() -> None:
        server = await asyncio.start_server(fall_silent, "127.0.0.1", free_port)
        async with server, reading(make_source(free_port, "u"), recorder) as task:
            await recorder.wait_until(task.done)
            assert isinstance(task.exception(), aiomqtt.MqttError)

    run(test())


async def blast(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, count: int) -> None:
    """A broker in the fewest bytes: it sends its client ``count`` messages of one topic at once, and one of another."""

    async def take() -> tuple[int, bytes]:
        first, length = await reader.readexactly(2)  # of less than 128 bytes
        return first >> 4, await reader.readexactly(length)

    def put(topic: bytes, payload: bytes) -> None:
        body = len(topic).to_bytes(2, "big") + topic + payload
        writer.write(bytes([0x30, len(body)]) + body)

    await take()
    writer.write(b"\x20\x02\x00\x00")
    _, asked = await take()
    writer.write(b"\x90\x04" + asked[:2] + b"\x00\x00")
    for k in range(count):
        put(b"loud", b"%d" % k)
    put(b"quiet", b"1")
    await writer.drain()
    with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
        await take()
    writer.close()


def test_a_broker_that_floods_is_taken_or_counted_to_the_last_message(free_port: int, recorder, reading, run) -> None:
    count = 20_000

    async def test() -> None:
        server = await asyncio.start_server(lambda r, w: blast(r, w, count), "127.0.0.1", free_port)
        async with server, reading(make_source(free_port, "loud", "quiet"), recorder):
            await recorder.wait_until(
                lambda: (
                    len(recorder.readings) + len(recorder.rejected) == count + 1
                    and recorder.values_of("quiet") == [1.0]
                )
            )

    run(test())
    assert recorder.values_of("loud")[-1] == count - 1
    assert {reason for reason, _ in recorder.rejected} <= {"dropped"}
