"""Checks of the files of a process's credentials, and the reason why another process rejects them."""

from __future__ import annotations

import datetime
import socket
import ssl
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed448 import Ed448PublicKey
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from cryptography.x509.verification import Criticality, ExtensionPolicy, PolicyBuilder, Store, VerificationError

from agents.security.credential_files import Credentials, find_mode_problems
from dsse_core.files.bounded_file import LARGEST_PEM, read_bounded

FOR_LINKS_ONLY = Ed25519PublicKey, Ed448PublicKey  # keys of authorities that links accept, and the library does not
PROBE_S = 5.0  # time for a handshake that only finds the reason of a missing link


def find_credential_problems(credentials: Credentials, listens: bool) -> list[str]:
    """Every problem: the file, what was found, what to do. ``listens``: other processes call this one, too."""
    now = datetime.datetime.now(datetime.UTC)
    problems: list[str] = []
    authorities = _read_certificates(credentials.authority, problems)
    chain = _read_certificates(credentials.certificate, problems)
    key = _read_key(credentials.key, problems)
    for path, certificates in ((credentials.authority, authorities), (credentials.certificate, chain)):
        for certificate in certificates:
            problems += _find_date_problems(path, certificate, now)
    has_wrong_date = bool(problems)
    if not chain:
        return problems
    own = chain[0]
    if (found := _common_name(own)) != credentials.name:
        problems.append(
            f"{credentials.certificate}: is the certificate of {found!r}, and {credentials.name!r} is needed; "
            "take that process's certificate, or make one with this common name"
        )
    problems += _find_usage_problems(credentials.certificate, own, listens)
    if key and key.public_key() != own.public_key():
        problems.append(_does_not_belong(credentials.certificate, credentials.key))
    if authorities:
        dates = [certificate.not_valid_before_utc for certificate in (*chain, *authorities)]
        problems += _find_chain_problems(credentials, chain, authorities, max(dates) if has_wrong_date else now)
    return problems


def find_pair_problems(certificate: Path, key: Path) -> list[str]:
    """Every problem of a server's own certificate and its key; the issuer is not checked."""
    now = datetime.datetime.now(datetime.UTC)
    problems: list[str] = []
    chain, private = _read_certificates(certificate, problems), _read_key(key, problems)
    problems += [problem for one in chain for problem in _find_date_problems(certificate, one, now)]
    if chain and private and private.public_key() != chain[0].public_key():
        problems.append(_does_not_belong(certificate, key))
    return problems


def _does_not_belong(certificate: Path, key: Path) -> str:
    return f"{key}: does not belong to {certificate}; copy both from one place"


def _read_certificates(path: Path, problems: list[str]) -> list[x509.Certificate]:
    try:
        content = read_bounded(path, LARGEST_PEM)
        problems += find_mode_problems(path)
        return x509.load_pem_x509_certificates(content)
    except OSError as error:
        problems.append(_describe_unreadable(path, error))
    except ValueError:
        problems.append(f"{path}: holds no certificate in PEM (-----BEGIN CERTIFICATE-----); copy it again")
    return []


def _read_key(path: Path, problems: list[str]) -> PrivateKeyTypes | None:
    try:
        content = read_bounded(path, LARGEST_PEM)
        problems += find_mode_problems(path, private=True)
        return serialization.load_pem_private_key(content, password=None)
    except OSError as error:
        problems.append(_describe_unreadable(path, error))
    except TypeError:
        problems.append(f"{path}: is protected by a password, which cannot be asked for; store it without one")
    except (ValueError, UnsupportedAlgorithm):
        problems.append(f"{path}: holds no private key in PEM (-----BEGIN PRIVATE KEY-----); copy it again")
    return None


def _describe_unreadable(path: Path, error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return f"{path}: is missing; make it with `dsse keys create SCENARIO`, or copy it from where that was done"
    return f"{path}: cannot be read: {error.strerror}"


def _find_date_problems(path: Path, certificate: x509.Certificate, now: datetime.datetime) -> list[str]:
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > end:
        return [f"{path}: expired at {end:%Y-%m-%d %H:%M} UTC; make new keys with `dsse keys create SCENARIO`"]
    if now < begin:
        return [f"{path}: is valid from {begin:%Y-%m-%d %H:%M} UTC on; is this host's clock right ({now:%Y-%m-%d})?"]
    return []


def _find_usage_problems(path: Path, certificate: x509.Certificate, listens: bool) -> list[str]:
    try:
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return []  # good for everything
    problems = []
    if ExtendedKeyUsageOID.CLIENT_AUTH not in usage:
        problems.append(f"{path}: its extended key usage lacks clientAuth, and this process calls others")
    if listens and ExtendedKeyUsageOID.SERVER_AUTH not in usage:
        problems.append(
            f"{path}: is for a process that only calls others (its extended key usage lacks serverAuth), and this one "
            "listens; make keys for this scenario with `dsse keys create SCENARIO`"
        )
    return problems


def _common_name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _find_chain_problems(
    credentials: Credentials,
    chain: Sequence[x509.Certificate],
    authorities: Sequence[x509.Certificate],
    at: datetime.datetime,
) -> list[str]:
    """Problem of the issuers of the first of ``chain``, which lead by way of the others to one of ``authorities``."""
    own, *between = chain
    if any(isinstance(one.public_key(), FOR_LINKS_ONLY) for one in (*between, *authorities)):
        return []  # the other end of a link checks them
    of_authority = ExtensionPolicy.permit_all().require_present(x509.BasicConstraints, Criticality.AGNOSTIC, None)
    policy = PolicyBuilder().store(Store(list(authorities))).time(at)
    policy = policy.extension_policies(ca_policy=of_authority, ee_policy=ExtensionPolicy.permit_all())
    try:
        policy.build_client_verifier().verify(own, between)
    except VerificationError as error:
        problem = (
            f"{credentials.certificate}: was issued by {own.issuer.rfc4514_string()!r}, not by the authority in "
            f"{credentials.authority}; take certificate and authority from the same `dsse keys create`"
        )
        if "path length" in str(error):
            problem = (
                f"{credentials.certificate}: has more authorities between it and {credentials.authority} than one of "
                "them allows (path length of its basicConstraints); take a certificate from an authority closer to it"
            )
        elif "basicConstraints" in str(error):
            problem = (
                f"{credentials.certificate}: an issuer of it, here or in {credentials.authority}, is no authority "
                "(its basicConstraints lack CA); take a certificate that an authority has issued"
            )
        return [problem]
    return []


def explain_rejection(endpoint: str, credentials: Credentials) -> str:
    """Reason why there is no link with ``endpoint`` (``tls/HOST:PORT``), in words; empty if unknown.

    Zenoh reports only a timeout. A handshake outside Zenoh shows the objection of the other side, or of this one.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        context = ssl.create_default_context(cafile=str(credentials.authority))
        context.load_cert_chain(str(credentials.certificate), str(credentials.key))
    except OSError as error:
        return f"{credentials.certificate} with its key and authority cannot be used here: {error}"
    try:
        with (
            socket.create_connection((host.strip("[]"), int(port)), PROBE_S) as plain,
            context.wrap_socket(plain, server_hostname=host.strip("[]")) as link,
        ):
            link.recv(1)  # where the router's verdict on our certificate arrives
    except TimeoutError:
        return ""
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is rejected here: {error.verify_message} (believed is {credentials.authority})"
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).removeprefix("TLSV1_ALERT_").removeprefix("SSLV3_ALERT_")
        return f"it rejects {credentials.certificate}: {reason.replace('_', ' ').lower()}"
    except (OSError, ValueError) as error:
        return str(error)
    return ""


def read_validity(path: Path) -> list[tuple[datetime.datetime, datetime.datetime]]:
    """(begin, end) of the validity of each certificate in ``path``; empty if none can be read."""
    return [(c.not_valid_before_utc, c.not_valid_after_utc) for c in _read_certificates(path, [])]
