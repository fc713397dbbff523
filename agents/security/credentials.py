"""Keys of a process: its certificate, the authority that it trusts, and the access rules of its links.

A folder of keys holds ``access.toml`` and, in PEM, ``authority.crt`` and for each process named NAME that runs here
``NAME.crt`` (common name NAME; the authorities between it and ``authority.crt`` may follow in it) and ``NAME.key``.
Where there is a folder NAME in it, all of these files of this process are there.
"""

from __future__ import annotations

import datetime
import logging
import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from agents.security.access import Access
from agents.security.credential_files import Credentials, credentials_in, folder_of_process
from dsse_core.errors import InvalidInputError

log = logging.getLogger(__name__)
AHEAD = datetime.timedelta(days=30)
SHARE = 3  # a certificate with a short life ends soon only in its last third
DAY_S = 86400.0


def describe_expiry(credentials: Credentials, now: datetime.datetime) -> list[str]:
    """Sentences about the certificates in ``credentials`` that end soon, and what to do; unreadable ones are left out.

    ``now``: with its time zone.
    """
    from agents.security.certificate_checks import read_validity  # not needed without keys

    lines = []
    for path in (credentials.authority, credentials.certificate):
        for begin, end in read_validity(path):
            if now > end - min(AHEAD, (end - begin) / SHARE):
                when = f"expired at {end:%Y-%m-%d %H:%M} UTC" if now > end else f"expires at {end:%Y-%m-%d %H:%M} UTC"
                lines.append(
                    f"{path}: {when}, and its links end then; put a new one in its place and send SIGHUP to the process"
                )
    return lines


class ExpiryWatch:
    """Logs now and every day the certificates of ``credentials`` that end soon, until ``stop``."""

    def __init__(self, credentials: Credentials) -> None:
        self._credentials = credentials
        self._stopped = threading.Event()
        self._warn()
        threading.Thread(target=self._go_on, daemon=True).start()

    def stop(self) -> None:
        self._stopped.set()

    def _go_on(self) -> None:
        while not self._stopped.wait(DAY_S):
            self._warn()

    def _warn(self) -> None:
        for line in describe_expiry(self._credentials, datetime.datetime.now(datetime.UTC)):
            log.warning("%s", line)


@dataclass(frozen=True, slots=True)
class Keys:
    """The credentials of a process and the rules of its run, which it applies to all its links.

    ``listens``: True where other processes call this one.
    """

    folder: Path
    name: str
    access: Access
    listens: bool = False

    @property
    def credentials(self) -> Credentials:
        """Paths of the process's own files."""
        return credentials_in(self.folder, self.name)

    def load_anew(self) -> Keys:
        """The same keys, read again from the files.

        Raises:
            InvalidInputError: as ``load_keys``.
        """
        return _load(self.folder, self.name, self.access.run, self.listens)


def load_keys(folder: Path | None, name: str, run: str | None = None, *, listens: bool = False) -> Keys | None:
    """The keys of process ``name`` in ``folder``, checked as far as they can be without the bus; None without.

    ``run``: the rules apply to it, instead of the run that the access file names.

    Raises:
        InvalidInputError: for each file that is missing, unreadable, expired, another process's or another
            authority's, what was found and what to do; or ``name`` is revoked.
    """
    return None if folder is None else _load(folder, name, run, listens)


def _load(folder: Path, name: str, run: str | None, listens: bool) -> Keys:
    from agents.security.access_file import ACCESS_FILE, load_access  # a process without keys does not wait for it

    check_credentials(folder, [name], [name] if listens else [])
    rules = folder_of_process(folder, name) / ACCESS_FILE
    access = load_access(rules)
    if name in access.revoked:
        raise InvalidInputError(
            f"access file {rules}",
            [f"revoked: names {name!r}, and this process would be {name!r}; no process would receive it"],
        )
    return Keys(folder, name, replace(access, run=run) if run else access, listens)


def check_credentials(folder: Path, names: Sequence[str], listeners: Collection[str]) -> None:
    """Raise the InvalidInputError of ``load_keys`` with the problems of the files of all processes ``names``.

    ``listeners``: those of ``names`` that other processes call.
    """
    from agents.security.certificate_checks import find_credential_problems  # not needed without keys

    problems = [
        problem
        for name in names
        for problem in find_credential_problems(credentials_in(folder, name), name in listeners)
    ]
    if problems:
        raise InvalidInputError(f"keys {folder}", list(dict.fromkeys(problems)))
