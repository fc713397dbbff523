"""``dsse keys create``: a private authority and one certificate per process, for a test or a small deployment."""

from __future__ import annotations

import datetime
import ipaddress
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from agents.security.access import OPERATOR, PLANT, ROUTER, WATCHER, Access, find_name_problems
from agents.security.access_file import ACCESS_FILE, load_access, save_access
from agents.security.credential_files import (
    AUTHORITY,
    credentials_in,
    folder_of_process,
    make_private_folder,
    write_private,
    write_public,
)
from agents.security.credentials import check_credentials
from coordinator.watch.run_folder import folder_error
from dsse_core.errors import InvalidInputError
from scenarios.files.whole_folder import written_whole

HERE = ("localhost", "127.0.0.1", "::1")
LONGEST_HOST = 253  # letters of a name in the DNS, RFC 1035
LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
LONGEST_NAME = 64  # letters of a common name, X.520
CLOCKS_DIFFER = datetime.timedelta(minutes=5)  # a certificate is valid from so long before its creation


def listeners_of(access: Access, direct: bool) -> tuple[str, ...]:
    """Processes that others connect to: the routers, or, ``direct``, all areas."""
    return tuple(access.neighbours) if direct else (ROUTER,)


def check_keys(folder: Path, access: Access, direct: bool = False) -> None:
    """Check that ``folder`` has good credentials of all processes of a run, and rules for its areas and neighbours.

    ``direct``: areas listen, without a router.

    Raises:
        InvalidInputError: every problem of the files, or of the rules.
    """
    needed = [name for name in access.names if name not in (OPERATOR, WATCHER, *access.gateways_by_name)]
    check_credentials(folder, needed, listeners_of(access, direct))
    for path in dict.fromkeys(folder_of_process(folder, name) / ACCESS_FILE for name in needed):
        _check_rules(path, access, needed)


def _check_rules(path: Path, access: Access, needed: Collection[str]) -> None:
    rules = load_access(path)
    there = rules.neighbours
    problems = [
        f"area {area} has neighbours {', '.join(found) or 'none'} there, {', '.join(wanted) or 'none'} in the scenario"
        for area in sorted({*there, *access.neighbours})
        if (found := there.get(area, ())) != (wanted := access.neighbours.get(area, ()))
    ]
    problems += [
        f"gateway {gateway} sends readings to {', '.join(found) or 'nobody'} there, to {', '.join(wanted) or 'nobody'} "
        "in the scenario"
        for gateway in sorted({PLANT, *rules.gateways, *access.gateways})
        if set(found := rules.areas_of(gateway)) != set(wanted := access.areas_of(gateway))
    ]
    problems += [
        f"revoked: {name} is denied everything, and is a part of this scenario"
        for name in rules.revoked
        if name in needed
    ]
    if problems:
        raise InvalidInputError(f"access file {path}", [*problems, "make keys for this scenario: dsse keys create"])


def create_keys(
    folder: Path, access: Access, days: float, hosts: Sequence[str] = (), *, direct: bool = False, apart: bool = False
) -> None:
    """Write authority, certificates, private keys and the rules of access into ``folder``, new or empty.

    ``apart``: into a folder for each process with all that it needs, and one for the authority, which no process needs.
    Only the owner of the files can read a key, whatever the umask. ``hosts``: names and addresses of the listening
    processes, beside those of loopback: routers, or, ``direct``, areas; ``area1=HOST`` is one of area1 alone. All other
    certificates are for clients only, so that no other process can pose as a router.

    Raises:
        InvalidInputError: ``folder`` holds something already, or a name does not fit into a certificate.
        OSError: ``folder`` cannot be made or written; then it is as before.
    """
    problems = [
        f"{name!r} is longer than the {LONGEST_NAME} letters of a certificate's common name; shorten it"
        for name in access.names
        if len(name) > LONGEST_NAME
    ]
    problems += find_name_problems(access)
    listeners = listeners_of(access, direct)
    problems += [problem for host in hosts if (problem := _find_host_problem(host, listeners))]
    if AUTHORITY in access.names:
        problems.append(f"area {AUTHORITY!r}: its files would be those of the authority; name the area otherwise")
    if problems:
        raise InvalidInputError("keys", problems)
    try:
        occupied = folder.exists() and any(folder.iterdir())
    except OSError as error:
        raise folder_error(f"keys {folder}", error) from None
    if occupied:
        raise InvalidInputError(f"keys {folder}", ["is not empty; keys are never overwritten: choose a new folder"])
    try:
        with written_whole(folder, make_private_folder) as new:
            _write_keys(new, access, days, hosts, listeners)
            if apart:
                _set_apart(new, access.names)
    except (FileExistsError, NotADirectoryError) as error:
        raise folder_error(f"keys {folder}", error) from None


def _write_keys(folder: Path, access: Access, days: float, hosts: Sequence[str], listeners: Sequence[str]) -> None:
    authority = credentials_in(folder, AUTHORITY)
    signing_key = ec.generate_private_key(ec.SECP256R1())
    issuer = _name(f"authority of {access.run}"[:LONGEST_NAME])
    _write_key(authority.key, signing_key)
    _write_certificate(authority.certificate, _build_authority(issuer, signing_key, days))
    for name in access.names:
        files = credentials_in(folder, name)
        key = ec.generate_private_key(ec.SECP256R1())
        names = _hosts_of(name, hosts) if name in listeners else ()
        _write_key(files.key, key)
        _write_certificate(files.certificate, _build_certificate(name, key, issuer, signing_key, days, names))
    save_access(folder / ACCESS_FILE, access)


def _set_apart(folder: Path, names: Sequence[str]) -> None:
    shared = [
        (path.name, path.read_bytes()) for path in (credentials_in(folder, AUTHORITY).certificate, folder / ACCESS_FILE)
    ]
    for name in (*names, AUTHORITY):
        files = credentials_in(folder, name)
        make_private_folder(folder / name)
        for path in (files.certificate, files.key):
            path.rename(folder / name / path.name)
        for shared_name, content in shared if name != AUTHORITY else ():
            write_public(folder / name / shared_name, content)
    (folder / ACCESS_FILE).unlink()


def _build_authority(name: x509.Name, key: ec.EllipticCurvePrivateKey, days: float) -> x509.Certificate:
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        _begin(name, name, key, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )


def _build_certificate(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    issuer: x509.Name,
    signing_key: ec.EllipticCurvePrivateKey,
    days: float,
    hosts: Sequence[str],
) -> x509.Certificate:
    """Certificate of a client, and, with ``hosts``, of a server under these names as well; a linked router is both."""
    usage = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    issued_by = x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key())
    builder = (
        _begin(_name(name), issuer, key, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usage), critical=True)
        .add_extension(issued_by, critical=False)
    )
    if hosts:
        names = x509.SubjectAlternativeName([_host(host) for host in dict.fromkeys(hosts)])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(signing_key, hashes.SHA256())


def _begin(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS_DIFFER)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _find_host_problem(text: str, listeners: Sequence[str]) -> str:
    name, given, host = text.rpartition("=")
    if not _is_host(host):
        return (
            f"host {host!r} is neither a name nor an address; without port and protocol, as grid-a.example or 192.0.2.7"
        )
    if given and name not in listeners:
        return f"host {text!r}: {name!r} does not listen; the processes that listen are {', '.join(listeners)}"
    return ""


def _hosts_of(name: str, hosts: Sequence[str]) -> tuple[str, ...]:
    """Hosts of process ``name``: loopback, the hosts given for all, and those given for it."""
    parts = [host.rpartition("=") for host in hosts]
    return (*HERE, *(host for whose, given, host in parts if not given or whose == name))


def _is_host(host: str) -> bool:
    """True for an address, and for a name of letters, digits, hyphens and underscores whose last label is no number."""
    labels = host.split(".")
    is_name = len(host) <= LONGEST_HOST and all(map(LABEL.fullmatch, labels)) and not labels[-1].isdigit()
    return is_name or (host.isascii() and isinstance(_host(host), x509.IPAddress))


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_private(path, text)


def _write_certificate(path: Path, certificate: x509.Certificate) -> None:
    write_public(path, certificate.public_bytes(serialization.Encoding.PEM))
