"""Source ``mqtt``: topics of a broker. Needs aiomqtt, extra ``mqtt``."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Container, Mapping, Sequence
from typing import Any, Literal

import aiomqtt
from pydantic import Field, field_validator

from coordinator.field.gateway.broker import BrokerSettings, connect
from coordinator.field.gateway.interface import Emit, Source
from coordinator.field.gateway.sources.texts import (
    NotUsableError,
    as_number,
    as_time,
    as_validity,
    find_at,
    parse_object,
)

MALFORMED, DROPPED, NO_TIME = "malformed", "dropped", "retained without a time"
MOST_OF_A_TOPIC = 100  # waiting messages of one topic; a flood of one topic displaces no other
LARGEST_PAYLOAD = 2**16  # bytes
OTHERS = "# without an address"  # stands for all topics that the map does not have


class MqttSettings(BrokerSettings):
    """Keys of ``[source]``. ``topics``: subscriptions in place of the topics of the addresses. ``value``, ``time``,
    ``valid``, ``unit``: their places in a payload that is a JSON object, keys with dots between them.
    """

    topics: list[str] = Field(default_factory=list)
    qos: Literal[0, 1, 2] = 1
    value: str = "value"
    time: str = "time"
    valid: str = "valid"
    unit: str = "unit"

    @field_validator("topics")
    @classmethod
    def _can_be_subscribed_to(cls, topics: list[str]) -> list[str]:
        for topic in topics:
            *levels, last = topic.split("/")
            fits = all(level == "+" or not {"+", "#"} & set(level) for level in (*levels, "" if last == "#" else last))
            if not topic or "\0" in topic or not fits:
                raise ValueError(f"{topic!r:.80} cannot be subscribed to; + stands for a level, # for all that follow")
        return topics


class MqttSource(Source):
    """Reads topics. An address is a topic, whose payload is a number or a JSON object. ``TOPIC#PATH`` names the place
    of the value in the object, so that one message can carry many meters.

    A retained message has the age that its time states; without a time it is no reading.
    """

    Settings = MqttSettings
    settings: MqttSettings

    def __init__(self, settings: Any, addresses: Sequence[str]) -> None:
        super().__init__(settings, addresses)
        self.paths: dict[str, list[tuple[str, str]]] = {}  # topic -> its addresses, each with the path of its value
        for address in addresses:
            topic, _, path = address.partition("#")
            self.paths.setdefault(topic, []).append((address, path or settings.value))

    @classmethod
    def find_address_problem(cls, address: str) -> str:
        topic, has_path, path = address.partition("#")
        if not topic or "+" in topic or (has_path and (not path or topic.endswith("/"))):
            return "a topic without wildcards, or TOPIC#PATH, such as feeder1/power#phases.total"
        return ""

    async def read(self, emit: Emit) -> None:
        queue = FairQueue(self.paths.keys())
        async with connect(self.settings, queue_type=lambda maxsize: queue) as client:
            subscribed: list[tuple[str, int]] = [
                (topic, self.settings.qos) for topic in self.settings.topics or self.paths
            ]
            await client.subscribe(subscribed)
            async for message in client.messages:
                if queue.dropped:
                    report_dropped(queue, emit)
                self._take(message, emit)

    def _take(self, message: aiomqtt.Message, emit: Emit) -> None:
        topic, payload = str(message.topic), message.payload
        if not isinstance(payload, bytes) or len(payload) > LARGEST_PAYLOAD:
            emit.reject(MALFORMED, f"topic {topic}: payload of more than {LARGEST_PAYLOAD} bytes, or of none")
            return
        places = self.paths.get(topic, [(topic, self.settings.value)])
        if payload.lstrip()[:1] == b"{":
            self._take_object(topic, payload, places, bool(message.retain), emit)
        elif message.retain:
            emit.reject(NO_TIME, f"topic {topic}: the broker has kept it for an unknown time")
        else:
            text = payload.decode("utf-8", "replace").strip()
            for address, path in places:
                if path == self.settings.value:
                    emit(address, as_number(text))
                else:
                    emit.reject(MALFORMED, f"address {address}: the payload is no JSON object, but {text!r:.80}")

    def _take_object(
        self, topic: str, payload: bytes, places: Sequence[tuple[str, str]], is_kept: bool, emit: Emit
    ) -> None:
        try:
            content: Mapping[str, Any] = parse_object(payload)
        except NotUsableError as error:
            emit.reject(MALFORMED, f"topic {topic}: payload {payload[:80]!r}: {error}")
            return
        _, time = find_at(content, self.settings.time)
        if is_kept and time is None:
            emit.reject(NO_TIME, f"topic {topic}: the broker has kept it for an unknown time")
            return
        valid = as_validity(find_at(content, self.settings.valid)[1])
        unit = find_at(content, self.settings.unit)[1]
        for address, path in places:
            found, value = find_at(content, path)
            if found:
                stated = None if unit is None else str(unit)
                emit(address, value, as_time(time), valid=valid, unit=stated)
            else:
                emit.reject(MALFORMED, f"address {address}: nothing at {path} of payload {payload[:80]!r}")


class FairQueue(asyncio.Queue[aiomqtt.Message]):
    """Queue with at most MOST_OF_A_TOPIC messages of each topic; beyond that, the oldest of the topic is dropped and
    counted. All topics that are not ``known`` count as one, since their number has no limit.
    """

    def __init__(self, known: Container[str]) -> None:
        self.known = known
        self.dropped: dict[str, int] = {}
        super().__init__()

    def _init(self, maxsize: int) -> None:
        self._by_topic: dict[str, deque[aiomqtt.Message]] = {}
        self._count = 0

    def qsize(self) -> int:
        return self._count

    def empty(self) -> bool:
        return self._count == 0

    def _put(self, item: aiomqtt.Message) -> None:
        topic = str(item.topic) if str(item.topic) in self.known else OTHERS
        waiting = self._by_topic.setdefault(topic, deque())
        if isinstance(item.payload, bytes) and len(item.payload) > LARGEST_PAYLOAD:
            item.payload = item.payload[: LARGEST_PAYLOAD + 1]  # still too large, but with less memory
        waiting.append(item)
        self._count += 1
        if len(waiting) > MOST_OF_A_TOPIC:
            waiting.popleft()
            self._count -= 1
            self.dropped[topic] = self.dropped.get(topic, 0) + 1

    def _get(self) -> aiomqtt.Message:
        topic, waiting = next(iter(self._by_topic.items()))
        item = waiting.popleft()
        self._count -= 1
        del self._by_topic[topic]
        if waiting:
            self._by_topic[topic] = waiting  # behind the other topics
        return item


def report_dropped(queue: FairQueue, emit: Emit) -> None:
    for topic, count in queue.dropped.items():
        for _ in range(count):
            emit.reject(DROPPED, f"topic {topic}: more messages than this host can take; the newest are kept")
    queue.dropped.clear()
