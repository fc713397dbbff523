"""Whose certificate it is, and what is said of files that do not belong together."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from agents.security.access import Access
from agents.security.certificate_checks import explain_rejection, find_credential_problems
from agents.security.credential_files import Credentials, credentials_in
from coordinator.lab.deployment.certificates import create_keys

ACCESS = Access("run", {"a": ("b",), "b": ("a",)})


@pytest.fixture
def own(tmp_path: Path) -> Credentials:
    create_keys(tmp_path / "keys", ACCESS, days=1)
    return credentials_in(tmp_path / "keys", "a")


@pytest.fixture
def foreign(tmp_path: Path) -> Credentials:
    create_keys(tmp_path / "others", ACCESS, days=1)
    return credentials_in(tmp_path / "others", "a")


def test_an_authority_that_stands_behind_a_foreign_certificate_has_not_issued_it(
    own: Credentials, foreign: Credentials
):
    assert not find_credential_problems(own, False)
    own.certificate.write_bytes(foreign.certificate.read_bytes() + own.authority.read_bytes())
    shutil.copy(foreign.key, own.key)
    (problem,) = find_credential_problems(own, False)
    assert "not by the authority in" in problem


def test_files_that_do_not_belong_together_are_named_when_nobody_answers(own: Credentials, foreign: Credentials):
    shutil.copy(foreign.key, own.key)
    assert f"{own.certificate} with its key and authority cannot be used here" in explain_rejection(
        "tls/127.0.0.1:1", own
    )
