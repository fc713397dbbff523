"""Keys that are good for everything, and sessions that keep to no rule: what a thief of keys has."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

from agents.security.access import Access
from agents.security.credential_files import credentials_in
from agents.security.credentials import Keys
from agents.transport.bus_config import at_once, bus_config, in_the_background
from coordinator.lab.deployment.certificates import HERE, _host
from tests.support.waiting import DEADLINE_S


def let_listen(keys: Path, name: str) -> None:
    """Have the authority in ``keys`` issue ``name``'s certificate again, for calling and for being called at HERE."""
    files, authority = credentials_in(keys, name), credentials_in(keys, "authority")
    signing_key = serialization.load_pem_private_key(authority.key.read_bytes(), None)
    assert isinstance(signing_key, ec.EllipticCurvePrivateKey)
    narrow = x509.load_pem_x509_certificate(files.certificate.read_bytes())
    builder = x509.CertificateBuilder(
        issuer_name=narrow.issuer,
        subject_name=narrow.subject,
        public_key=narrow.public_key(),
        serial_number=x509.random_serial_number(),
        not_valid_before=narrow.not_valid_before_utc,
        not_valid_after=narrow.not_valid_after_utc,
    )
    usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH])
    names = x509.SubjectAlternativeName([_host(host) for host in HERE])
    wide = builder.add_extension(usage, critical=False).add_extension(names, critical=False)
    certificate = wide.sign(signing_key, hashes.SHA256())
    files.certificate.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))


class Impostor:
    """A Zenoh session with the key of ``name``, if any, and no rules; it receives and says all that others let it."""

    def __init__(self, keys: Path | None, name: str, mode: str, **sections: Any) -> None:
        config = bus_config(mode, Keys(keys, name, Access("run", {})) if keys else None, **sections)
        config.pop("access_control", None)
        self.name = name
        self.received: set[tuple[str, str]] = set()  # (payload, key)
        self.seen: set[str] = set()
        self._lock = threading.Lock()
        self._published: set[bytes] = set()
        self._shown: set[str] = set()
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self._kept: list[Any] = []

    @classmethod
    def at(cls, endpoint: str, keys: Path | None, name: str, mode: str = "router") -> Impostor:
        """Where somebody else is looked for."""
        return cls(keys, name, mode, listen={"endpoints": [endpoint], "exit_on_failure": True})

    @classmethod
    def calling(cls, endpoints: Sequence[str], keys: Path | None, name: str, mode: str = "client") -> Impostor:
        """A router, or, as a peer, all areas."""
        connect = at_once(endpoints, DEADLINE_S) if mode == "client" else in_the_background(endpoints)
        return cls(keys, name, mode, connect=connect, listen={"endpoints": []})

    def listen(self, *expressions: str) -> None:
        """To all there is and to ``expressions``: what is too wide is rejected whole."""
        for expression in ("dsse/**", *expressions):
            self._kept.append(self._session.declare_subscriber(expression, self._note))
            self._kept.append(
                self._session.liveliness().declare_subscriber(
                    expression, lambda sample: self._see(str(sample.key_expr)), history=True
                )
            )

    def show(self, *keys: str) -> None:
        """Presence tokens."""
        self._shown |= set(keys)
        self._kept += [self._session.liveliness().declare_token(key) for key in keys]

    def publish(self, keys: Sequence[str], payload: bytes | None = None) -> list[Callable[[], None]]:
        """Functions that publish ``payload``, or its name, on each of ``keys``."""
        publishers = [self._session.declare_publisher(key) for key in keys]
        self._kept += publishers
        what = payload or self.name.encode()
        self._published.add(what)
        return [lambda p=p: p.put(what) for p in publishers]  # type: ignore[misc]

    def _note(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if payload not in self._published:  # a session receives itself
            with self._lock:  # a new set: who goes through the last one is on another thread
                self.received = self.received | {(payload.decode(errors="replace")[:40], str(sample.key_expr))}

    def _see(self, key: str) -> None:
        if key not in self._shown:
            with self._lock:
                self.seen = self.seen | {key}

    def __enter__(self) -> Impostor:
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.clear()
        self._session.close()  # type: ignore[no-untyped-call]
