"""Address at which a command answers over HTTP: ``--listen HOST:PORT``."""

from __future__ import annotations

from dsse_core.endpoints import HIGHEST_PORT
from dsse_core.errors import InvalidInputError


def parse_listen(text: str, example: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT`` or ``[HOST]:PORT``; port 0 stands for any free port.

    Raises:
        InvalidInputError: ``text`` has neither form; the error says what is wrong with it and shows ``example``.
    """
    host, colon, port = text.rpartition(":")
    if problem := _find_problem(text, host, colon, port):
        raise InvalidInputError(f"--listen {text}", [f"{problem}; HOST:PORT looks like {example}"])
    return host.removeprefix("[").removesuffix("]"), int(port)


def _find_problem(text: str, host: str, colon: str, port: str) -> str:
    """The reason why a text is no ``HOST:PORT``, empty if it is one."""
    if "/" in text:
        return f"{text[: text.rindex('/') + 1]!r} is too much"
    if not colon:
        return f"the {'host' if port.isdigit() else 'port'} is missing"
    if ":" in host and not host.endswith("]"):
        return "an IPv6 address stands in brackets"
    if not (port.isascii() and port.isdigit() and len(port) <= len("65535") and int(port) <= HIGHEST_PORT):
        return f"the port is {port[:20]!r}; it must be a number from 0, any that is free, to {HIGHEST_PORT}"
    return "" if host else "the host is missing"


def name_address(host: str, port: int) -> str:
    """``HOST:PORT`` as a URL has it."""
    return f"{f'[{host}]' if ':' in host else host}:{port}"
