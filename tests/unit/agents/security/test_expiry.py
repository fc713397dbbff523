"""Certificates that end soon are reported at the start and every day, and no others."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

from agents.security.access import Access
from agents.security.credential_files import Credentials, credentials_in
from agents.security.credentials import ExpiryWatch, describe_expiry
from coordinator.lab.deployment.certificates import create_keys
from tests.support.waiting import wait_until


def keys_for(folder: Path, days: float) -> Credentials:
    create_keys(folder, Access("run", {"a": ()}), days)
    return credentials_in(folder, "a")


def reported(credentials: Credentials, in_days: float) -> list[str]:
    return describe_expiry(credentials, datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=in_days))


def test_the_last_thirty_days_of_a_year_are_reported_for_both_certificates(tmp_path: Path):
    credentials = keys_for(tmp_path / "keys", days=365)
    assert reported(credentials, in_days=334) == []
    lines = reported(credentials, in_days=336)
    assert [line.partition(":")[0] for line in lines] == [str(credentials.authority), str(credentials.certificate)]
    assert all("expires at " in line and "send SIGHUP to the process" in line for line in lines)
    assert all("expired at " in line for line in reported(credentials, in_days=366))


def test_keys_of_one_day_are_not_reported_all_day(tmp_path: Path):
    credentials = keys_for(tmp_path / "keys", days=1)
    assert reported(credentials, in_days=0.6) == []
    assert len(reported(credentials, in_days=0.7)) == 2


def test_what_cannot_be_read_is_not_reported_here(tmp_path: Path):
    assert reported(credentials_in(tmp_path, "a"), in_days=0) == []


def test_it_is_reported_at_the_start_and_again_until_it_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr("agents.security.credentials.DAY_S", 0.001)
    monkeypatch.setattr("agents.security.credentials.AHEAD", datetime.timedelta(days=1000))
    monkeypatch.setattr("agents.security.credentials.SHARE", 0.5)
    watch = ExpiryWatch(keys_for(tmp_path / "keys", days=1))
    assert len(caplog.records) >= 2
    wait_until(lambda: len(caplog.records) >= 6)
    watch.stop()
