"""A real MQTT broker in this process."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator

from amqtt.broker import Broker


@contextlib.asynccontextmanager
async def broker(port: int) -> AsyncIterator[None]:
    """Serves at ``port`` of loopback, to anybody, until the end of the block."""
    config = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }
    found = Broker(config)
    await found.start()
    try:
        yield
    finally:
        await found.shutdown()
