"""Address at which a command answers over HTTP: ``--listen HOST:PORT``."""

from __future__ import annotations

from dsse_core.errors import InvalidInputError


def parse_listen(text: str, example: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT`` or ``[HOST]:PORT``; port 0 stands for any free port.

    Raises:
        InvalidInputError: ``text`` has neither form; the error shows ``example``.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit()) or int(port) > 65535:
        raise InvalidInputError(f"--listen {text}", [f"is no HOST:PORT; write {example}"])
    return host, int(port)


def name_address(host: str, port: int) -> str:
    """``HOST:PORT`` as a URL has it."""
    return f"{f'[{host}]' if ':' in host else host}:{port}"
