"""Endpoints to listen on that other hosts reach, where nobody needs a key, are reported."""

import logging

import pytest
import zenoh

from agents.transport import zenoh_bus as transport
from agents.transport.bus_config import find_open_endpoints
from agents.transport.zenoh_bus import Router, Session, TransportError

OPEN = ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/192.0.2.7:7447", "tcp/grid-a.example:7447", "tcp/[::%eth0]:0"]
PRIVATE = ["tcp/127.0.0.1:7447", "tcp/127.3.2.1:0", "tcp/[::1]:7447", "tcp/localhost:7447"]


def test_loopback_alone_is_private():
    assert find_open_endpoints([*OPEN, *PRIVATE]) == OPEN


@pytest.mark.parametrize(
    "listen", [Router.listen, lambda endpoints: Session.meet([], endpoints)], ids=["router", "area"]
)
@pytest.mark.parametrize("endpoint", [OPEN[0], PRIVATE[0]])
def test_nobody_listens_to_everybody_without_keys_and_without_notice(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, listen, endpoint: str
):
    def reject(config: object) -> None:
        raise zenoh.ZError("nothing is opened here")

    monkeypatch.setattr(transport, "_open", reject)
    with pytest.raises(TransportError):
        listen([endpoint])
    reported = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert bool(reported) == (endpoint in OPEN)
    assert all(
        f"listens without keys on {endpoint}: any process that reaches it may receive and send" in line
        for line in reported
    )


def test_with_keys_it_is_not_mentioned(caplog: pytest.LogCaptureFixture):
    transport.warn_of_strangers(["tls/0.0.0.0:7447"], secured=True)
    assert not caplog.records
