"""The web server: its address, its certificate, and a token beyond loopback."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, urlsplit

import uvicorn

from agents.security.certificate_checks import find_pair_problems
from agents.security.credential_files import write_private
from coordinator.show.web.app import make_app
from coordinator.show.web.readers import PatientProtocol, PatientServer
from coordinator.show.web.sources import Source
from coordinator.watch.http_front import LONGEST_REQUEST, MOST_READERS, Front, is_loopback, open_listener
from coordinator.watch.listen import name_address, parse_listen
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_bounded

LEAST_TOKEN, MOST_TOKEN = 16, 4096  # characters
MADE_TOKEN = 24  # bytes


@dataclass(frozen=True)
class PageAddress:
    """The address of a page: ``host`` and ``port`` (0: a free one), certificate and key in PEM, and a token.

    ``names``: further ones under which browsers ask for it, on loopback by a proxy.
    """

    host: str
    port: int
    certificate: Path | None = None
    key: Path | None = None
    token: str | None = None
    names: Sequence[str] = ()

    @property
    def is_loopback(self) -> bool:
        """True where only this machine reaches the page."""
        return is_loopback(self.host)

    def url(self, port: int) -> str:
        """The URL of the page at ``port``."""
        return f"{'https' if self.certificate else 'http'}://{name_address(self.host, port)}/"

    def invite(self, url: str) -> str:
        """The whole address to open, with its token; ``url``: that of the page. On loopback that of a proxy, too."""
        shown = f"/?token={quote(self.token, safe='')}" if self.token else "/"
        lines = [f"open {url.removesuffix('/')}{shown}"]
        if self.names and self.is_loopback:
            lines.insert(0, f"through a proxy: https://{self.names[0]}{shown}")
        elif self.names:
            name, _, port = self.names[0].partition(":")
            lines = [f"open https://{name}:{port or urlsplit(url).port}{shown}"]
        return "\n".join(lines)


def choose_place(
    listen: str, certificate: Path | None, key: Path | None, token_file: Path | None, names: tuple[str, ...]
) -> PageAddress:
    """The place that the options describe.

    Raises:
        InvalidInputError: naming all options that are wrong or missing; beyond loopback certificate, key and a name are
            needed. A token is made there, and kept in ``token_file``, if one is given that does not exist.
    """
    host, port = parse_listen(listen, "127.0.0.1:8080")
    problems = []
    if (certificate is None) != (key is None):
        problems.append("--tls-cert and --tls-key go together")
    if certificate and key:
        problems += find_pair_problems(certificate, key)
    token, is_kept = secrets.token_urlsafe(MADE_TOKEN), token_file is not None and token_file.exists()
    if token_file is not None and is_kept:
        try:
            token = read_bounded(token_file, MOST_TOKEN).decode("ascii").strip()
        except UnicodeDecodeError:
            problems.append(f"--token-file {token_file}: a token is of ASCII letters and digits")
        except OSError as error:
            problems.append(f"--token-file {token_file}: {error.strerror}")
        if len(token) < LEAST_TOKEN:
            problems.append(f"--token-file {token_file}: {len(token)} characters; {LEAST_TOKEN} at least")
    needs_token = token_file is not None or not is_loopback(host)
    place = PageAddress(host, port, certificate, key, token if needs_token else None, names)
    if not place.is_loopback:
        needed = {"--tls-cert and --tls-key": certificate, "--name": names or None}
        problems += [f"beyond loopback {name} is needed" for name, given in needed.items() if given is None]
    if problems:
        raise InvalidInputError(f"dsse serve --listen {listen}", problems)
    if token_file is not None and not is_kept:
        write_private(token_file, f"{token}\n".encode())
    return place


def serve(source: Source, place: PageAddress, names: tuple[str, ...], on_ready: Callable[[str], object]) -> None:
    """Serves ``source`` until SIGINT or SIGTERM. ``names``: further host names accepted in requests.

    ``on_ready``: called with the URL when the address is open.

    Raises:
        InvalidInputError: the address is in use or does not exist.
    """
    try:
        opened = open_listener(place.host, place.port)
    except OSError as error:
        cure = "choose another port, 0 for one that is free, or another address of this host"
        problem = f"{error.strerror}; {cure}"
        raise InvalidInputError(f"dsse serve --listen {name_address(place.host, place.port)}", [problem]) from None
    with opened as listener:
        port = listener.getsockname()[1]
        config = uvicorn.Config(
            make_app(source, Front.of(place.host, port, names), place.token),
            http=PatientProtocol,
            ws="none",
            lifespan="off",
            log_level="error",  # faulty requests would fill the log
            access_log=False,
            server_header=False,
            limit_concurrency=MOST_READERS + 1,  # beyond it a request gets status 503
            timeout_keep_alive=5,
            timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=LONGEST_REQUEST,
            ssl_certfile=place.certificate,
            ssl_keyfile=place.key,
        )
        on_ready(place.url(port))
        PatientServer(config).run(sockets=[listener])
