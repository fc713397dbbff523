"""The certificate and private key that a process shows on the bus, and the authority that it believes.

A folder of keys holds ``authority.crt`` and, for each process named NAME that runs here, ``NAME.crt`` (common name
NAME; the authorities between it and ``authority.crt`` may follow in it) and ``NAME.key``, all in PEM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dsse_core.errors import InvalidInputError

AUTHORITY = "authority"


@dataclass(frozen=True, slots=True)
class Credentials:
    """Files in PEM: ``authority`` is whom to believe, ``certificate`` and ``key`` are one's own."""

    name: str
    authority: Path
    certificate: Path
    key: Path


def credentials_in(folder: Path, name: str) -> Credentials:
    """Where the credentials of process ``name`` are in ``folder``, whether or not they are there."""
    return Credentials(name, folder / f"{AUTHORITY}.crt", folder / f"{name}.crt", folder / f"{name}.key")


def load_credentials(folder: Path | None, name: str) -> Credentials | None:
    """The credentials of process ``name`` in ``folder``, checked as far as they can be without the bus; None without.

    Raises:
        InvalidInputError: for each file that is missing, unreadable, expired, another process's or another
            authority's, what was found and what to do.
    """
    if folder is None:
        return None
    check_credentials(folder, [name])
    return credentials_in(folder, name)


def check_credentials(folder: Path, names: Sequence[str]) -> None:
    """Raise the InvalidInputError of ``load_credentials`` with the problems of all processes ``names`` together."""
    from agents.certificate_checks import find_credential_problems  # whoever has no keys need not wait for it

    problems = [problem for name in names for problem in find_credential_problems(credentials_in(folder, name))]
    if problems:
        raise InvalidInputError(f"keys {folder}", list(dict.fromkeys(problems)))
