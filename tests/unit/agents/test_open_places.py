"""Places to listen on that other hosts reach, where nobody needs a key, are told."""

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


@pytest.mark.parametrize("listen", [Router.listen, lambda places: Session.meet([], places)], ids=["router", "area"])
@pytest.mark.parametrize("place", [OPEN[0], PRIVATE[0]])
def test_nobody_listens_to_everybody_without_keys_and_without_a_word(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, listen, place: str
):
    def refuse(config: object) -> None:
        raise zenoh.ZError("nothing is opened here")

    monkeypatch.setattr(transport, "_open", refuse)
    with pytest.raises(TransportError):
        listen([place])
    told = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert bool(told) == (place in OPEN)
    assert all(f"listening without keys on {place}: everybody who reaches it may hear and say" in line for line in told)


def test_with_keys_it_is_no_word_worth(caplog: pytest.LogCaptureFixture):
    transport.warn_of_strangers(["tls/0.0.0.0:7447"], secured=True)
    assert not caplog.records
