"""Files of keys on the disk, with access rights that do not depend on the umask, from their first byte on."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path

from dsse_core import operating_system

AUTHORITY = "authority"
PRIVATE_FILE, PUBLIC_FILE, PRIVATE_FOLDER = 0o600, 0o644, 0o700


@dataclass(frozen=True, slots=True)
class Credentials:
    """Files in PEM of process ``name``: its ``certificate`` and ``key``, and the ``authority`` that it trusts."""

    name: str
    authority: Path
    certificate: Path
    key: Path


def folder_of_process(folder: Path, name: str) -> Path:
    """The folder with the files of process ``name``: its own one in ``folder`` if there is one, else ``folder``."""
    own = folder / name
    return own if own.is_dir() else folder


def credentials_in(folder: Path, name: str) -> Credentials:
    """Paths of the credentials of process ``name`` in ``folder``; the files need not exist."""
    folder = folder_of_process(folder, name)
    return Credentials(name, folder / f"{AUTHORITY}.crt", folder / f"{name}.crt", folder / f"{name}.key")


def make_private_folder(folder: Path) -> None:
    """Make ``folder``, and missing folders above it, for this user alone; an existing ``folder`` becomes private.

    Raises:
        OSError: it cannot be made, or is another user's.
    """
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    for place in reversed(missing):
        place.mkdir(mode=PRIVATE_FOLDER, exist_ok=True)
        place.chmod(PRIVATE_FOLDER)  # a umask may have removed rights of the owner
    folder.chmod(PRIVATE_FOLDER)


def write_private(path: Path, content: bytes) -> None:
    """Write a new file that only this user reads."""
    _write(path, content, os.O_EXCL, PRIVATE_FILE)


def write_public(path: Path, content: bytes) -> None:
    """Write a file that all users may read and only this user may change."""
    _write(path, content, os.O_TRUNC, PUBLIC_FILE)


def _write(path: Path, content: bytes, flag: int, mode: int) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | flag, PRIVATE_FILE), "wb") as file:
        operating_system.set_rights(file.fileno(), mode)
        file.write(content)


def find_mode_problems(path: Path, private: bool = False) -> list[str]:
    """Rights of users outside its group to change ``path``; ``private``: of all but its owner, to read it as well."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if private and mode & 0o077:
        return [
            f"{path}: other users than its owner may read or change this private key; give it to the user of the "
            f"process alone, chmod go-rwx {path}"
        ]
    if mode & 0o002:
        return [f"{path}: all users of this host may change this file; chmod o-w {path}"]
    return []
