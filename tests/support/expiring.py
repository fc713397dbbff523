"""Certificates whose time is nearly over, or over."""

from __future__ import annotations

import datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from agents.security.credential_files import credentials_in


def let_expire(keys: Path, name: str, in_s: float) -> None:
    """Have the authority in ``keys`` issue ``name``'s certificate again, valid since two days and until ``in_s``."""
    files, authority = credentials_in(keys, name), credentials_in(keys, "authority")
    signing_key = serialization.load_pem_private_key(authority.key.read_bytes(), None)
    assert isinstance(signing_key, ec.EllipticCurvePrivateKey)
    good = x509.load_pem_x509_certificate(files.certificate.read_bytes())
    now = datetime.datetime.now(datetime.UTC)
    builder = x509.CertificateBuilder(
        issuer_name=good.issuer,
        subject_name=good.subject,
        public_key=good.public_key(),
        serial_number=x509.random_serial_number(),
        not_valid_before=now - datetime.timedelta(days=2),
        not_valid_after=now + datetime.timedelta(seconds=in_s),
        extensions=list(good.extensions),
    )
    certificate = builder.sign(signing_key, hashes.SHA256())
    files.certificate.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
