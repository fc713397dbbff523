"""RenewableBus that are opened again with renewed keys bring back what was declared, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from agents.security.access import Access
from agents.security.access_file import ACCESS_FILE, load_access, save_access
from agents.security.credentials import Keys, load_keys
from agents.transport.renewable_bus import RenewableBus
from coordinator.lab.deployment.certificates import create_keys
from dsse_core.errors import DsseError
from tests.support.waiting import wait_until

ACCESS = Access("run", {"a": ("b",), "b": ("a",)})


class Bus:
    """What was declared on it, until it is closed."""

    def __init__(self, keys: Keys | None) -> None:
        self.keys = keys
        self.declared: list[str] = []
        self.closed = False

    def close(self) -> None:
        self.closed = True


class Opener:
    """Opens buses, or fails as often as ordered."""

    def __init__(self) -> None:
        self.opened: list[Bus] = []
        self.failures = 0

    def __call__(self, keys: Keys | None, _: float) -> Bus:
        if self.failures:
            self.failures -= 1
            raise (DsseError if self.failures % 2 else KeyError)("nobody is there")
        self.opened.append(Bus(keys))
        return self.opened[-1]


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    create_keys(tmp_path / "keys", ACCESS, days=1)
    loaded = load_keys(tmp_path / "keys", "a")
    assert loaded is not None
    return loaded


@pytest.fixture
def opener() -> Opener:
    return Opener()


@pytest.fixture
def bus(opener: Opener, keys: Keys) -> Iterator[RenewableBus]:
    with RenewableBus(opener, Bus.close, keys) as bus:
        yield bus


def declare(bus: RenewableBus, *names: str) -> None:
    for name in names:
        bus.declare(lambda bus, name=name: bus.declared.append(name) or name)


def test_what_was_declared_is_there_again_in_order_with_the_rules_of_now(opener: Opener, bus: RenewableBus, keys: Keys):
    declare(bus, "subscriber", "token")
    save_access(keys.folder / ACCESS_FILE, Access("run", {"a": ("b",), "b": ("a",)}, ("b",)))
    assert bus.interrupt()
    first = opener.opened[0]
    assert first.closed
    assert not bus.is_open(first)
    assert len(opener.opened) == 1
    opener.failures = 3
    bus.resume()
    wait_until(lambda: len(opener.opened) == 2 and opener.opened[1].declared == ["subscriber", "token"])
    second = opener.opened[1]
    assert second.keys is not None
    assert second.keys.access.revoked == ("b",)
    assert bus.is_open(second)


def test_keys_that_cannot_be_used_leave_links_as_they_were(
    opener: Opener, bus: RenewableBus, keys: Keys, caplog: pytest.LogCaptureFixture
):
    keys.credentials.certificate.write_text("rubbish")
    assert not bus.interrupt()
    assert [bus.closed for bus in opener.opened] == [False]
    assert "the keys in use stay as they were" in caplog.text
    assert "a.crt: holds no certificate in PEM" in caplog.text
    assert load_access(keys.folder / ACCESS_FILE) == keys.access


def test_without_keys_nothing_is_renewed(opener: Opener):
    with RenewableBus(opener, Bus.close) as bus:
        assert not bus.interrupt()
    assert [bus.closed for bus in opener.opened] == [True]


def test_who_closes_while_links_are_opened_again_does_not_wait_for_them(opener: Opener, bus: RenewableBus):
    assert bus.interrupt()
    opener.failures = 10**9
    bus.resume()
    bus.close()
    assert [bus.closed for bus in opener.opened] == [True]


def test_what_is_declared_while_there_are_no_links_comes_with_them(opener: Opener, bus: RenewableBus):
    assert bus.interrupt()
    declare(bus, "late")
    bus.resume()
    wait_until(lambda: len(opener.opened) == 2 and opener.opened[1].declared == ["late"])


def test_a_declaration_that_fails_is_tried_again_on_a_bus_of_its_own(opener: Opener, bus: RenewableBus):
    failures = [False, True, True]

    def declare_with_failures(bus: Bus) -> str:
        if failures and failures.pop(0):
            raise KeyError("the session has ended meanwhile")
        bus.declared.append("flaky")
        return "flaky"

    declare(bus, "first")
    bus.declare(declare_with_failures)
    assert bus.interrupt()
    bus.resume()
    wait_until(lambda: len(opener.opened) == 4 and opener.opened[3].declared == ["first", "flaky"])
    assert [bus.closed for bus in opener.opened] == [True, True, True, False]
    assert bus.is_open(opener.opened[3])


def test_a_second_renewal_during_the_first_leaves_one_bus_open(opener: Opener, bus: RenewableBus):
    for _ in range(5):
        assert bus.interrupt()
        bus.resume()
    wait_until(lambda: [bus.closed for bus in opener.opened].count(False) == 1)
    bus.close()
    assert all(bus.closed for bus in opener.opened)
