"""Sink ``mqtt``: each result on a topic of its area. Needs aiomqtt, extra ``mqtt``."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Annotated, Literal

from pydantic import Field

from coordinator.field.gateway.broker import BrokerSettings, connect
from coordinator.field.gateway.interface import Result, Sink


class MqttSettings(BrokerSettings):
    """Keys of ``[[results]]``. ``topic``: ``{run}`` and ``{area}`` in it stand for their names."""

    topic: Annotated[str, Field(pattern=r"^[^+#]+$")] = "dsse/{run}/{area}/state"
    qos: Literal[0, 1, 2] = 0
    retain: bool = False


class MqttSink(Sink):
    """Publishes each result as JSON."""

    Settings = MqttSettings
    settings: MqttSettings

    async def write(self, results: AsyncIterator[Result]) -> None:
        settings = self.settings
        async with connect(settings) as client:
            async for result in results:
                topic = settings.topic.replace("{run}", result["run"]).replace("{area}", result["area"])
                payload = json.dumps(result, allow_nan=False)
                await client.publish(topic, payload, qos=settings.qos, retain=settings.retain)
