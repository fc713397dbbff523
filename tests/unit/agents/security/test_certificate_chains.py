"""Whose certificate it is, and what is said of files that do not belong together."""

from __future__ import annotations

import datetime
import shutil
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

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


Key = ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey


def new_key() -> Key:
    return ec.generate_private_key(ec.SECP256R1())


def issue(subject: str, key: Key, issuer: str, signed_by: Key, basic: x509.BasicConstraints | None) -> bytes:
    """A certificate in PEM, valid today."""
    now = datetime.datetime.now(datetime.UTC)
    names = (x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]) for name in (issuer, subject))
    builder = x509.CertificateBuilder(*names, key.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(now - datetime.timedelta(days=1))
    builder = builder.not_valid_after(now + datetime.timedelta(days=1))
    if basic is not None:
        builder = builder.add_extension(basic, critical=True)
    algorithm = None if isinstance(signed_by, ed25519.Ed25519PrivateKey) else hashes.SHA256()
    return builder.sign(signed_by, algorithm).public_bytes(Encoding.PEM)


def write_chain(
    own: Credentials, *between: x509.BasicConstraints | None, root: x509.BasicConstraints, root_key: Key | None = None
) -> None:
    """Writes the certificate of ``a``, behind it its issuers from the nearest one on, and the root that it trusts."""
    key = root_key or new_key()
    names, signer = ["root"], key
    own.authority.write_bytes(issue("root", key, "root", key, root))
    chain: list[bytes] = []
    for k, basic in enumerate([*reversed(between), x509.BasicConstraints(ca=False, path_length=None)]):
        name, key = ("a" if k == len(between) else f"between {k}"), new_key()
        chain.insert(0, issue(name, key, names[-1], signer, basic))
        names.append(name)
        signer = key
    own.certificate.write_bytes(b"".join(chain))
    own.key.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


ANY_LENGTH = x509.BasicConstraints(ca=True, path_length=None)
NONE_BETWEEN = x509.BasicConstraints(ca=True, path_length=0)
NO_AUTHORITY = x509.BasicConstraints(ca=False, path_length=None)


@pytest.mark.parametrize("between", [(), (NONE_BETWEEN,), (NONE_BETWEEN, ANY_LENGTH)])
def test_issuers_that_are_authorities_lead_to_the_one_that_is_trusted(
    own: Credentials, between: tuple[x509.BasicConstraints, ...]
):
    write_chain(own, *between, root=ANY_LENGTH)
    assert find_credential_problems(own, False) == []


@pytest.mark.parametrize("basic", [NO_AUTHORITY, None])
def test_a_chain_through_a_certificate_that_is_no_authority_is_refused(
    own: Credentials, basic: x509.BasicConstraints | None
):
    write_chain(own, basic, root=ANY_LENGTH)
    (problem,) = find_credential_problems(own, False)
    assert "a.crt: an issuer of it, here or in" in problem
    assert "is no authority (its basicConstraints lack CA)" in problem


@pytest.mark.parametrize(("between", "root"), [((ANY_LENGTH,), NONE_BETWEEN), ((ANY_LENGTH, NONE_BETWEEN), ANY_LENGTH)])
def test_a_chain_longer_than_one_of_its_authorities_allows_is_refused(
    own: Credentials, between: tuple[x509.BasicConstraints, ...], root: x509.BasicConstraints
):
    write_chain(own, *between, root=root)
    (problem,) = find_credential_problems(own, False)
    assert "than one of them allows (path length of its basicConstraints)" in problem


def test_an_authority_with_a_key_that_only_links_check_is_not_refused(own: Credentials):
    write_chain(own, root=ANY_LENGTH, root_key=ed25519.Ed25519PrivateKey.generate())
    assert find_credential_problems(own, False) == []


def test_certificates_of_another_authority_are_named_even_if_expired(own: Credentials, foreign: Credentials):
    create_keys(own.authority.parent.with_name("old"), ACCESS, days=-1e-4)
    old = credentials_in(own.authority.parent.with_name("old"), "a")
    old.authority.write_bytes(foreign.authority.read_bytes())
    expired, issuer = find_credential_problems(old, False)
    assert "a.crt: expired at" in expired
    assert "a.crt: was issued by" in issuer
