"""Endpoints of areas that link with their neighbours directly."""

from __future__ import annotations

import socket
from contextlib import ExitStack

from dsse_core.errors import InvalidInputError
from scenarios.scenario import Scenario

HIGHEST_PORT = 65535


def choose_area_endpoints(scenario: Scenario, protocol: str = "tcp") -> dict[str, str]:
    """Area -> its endpoint: ports that count up from that of ``transport.listen``, or free ones if it is 0.

    Raises:
        InvalidInputError: there are too few ports, or the host is not this one.
    """
    names = [area.name for area in scenario.partition.areas]
    host, _, text = scenario.transport.listen.partition("/")[2].rpartition(":")
    first = int(text)
    if first + len(names) - 1 > HIGHEST_PORT:
        problem = (
            f"{len(names)} areas need as many ports, and {first} is too near to {HIGHEST_PORT}; choose a lower one"
        )
        raise InvalidInputError("transport.listen", [problem])
    ports = range(first, first + len(names)) if first else _find_free_ports(host, len(names))
    return {name: f"{protocol}/{host}:{port}" for name, port in zip(names, ports, strict=True)}


def known_area_endpoints(scenario: Scenario, protocol: str = "tcp") -> dict[str, str]:
    """``choose_area_endpoints`` for processes that have not started the areas; every call gives the same endpoints.

    Raises:
        InvalidInputError: the scenario lets areas take free ports, or there are too few.
    """
    if scenario.transport.listen.endswith(":0"):
        problem = (
            "port 0 lets each area take a free one, which no other process knows; give --connect once for each area, "
            "with `listen` of its area file, or fix the port in the scenario and split it again"
        )
        raise InvalidInputError("transport.listen", [problem])
    return choose_area_endpoints(scenario, protocol)


def _find_free_ports(host: str, count: int) -> list[int]:
    """Ports of this host that are free at this moment."""
    with ExitStack() as open_sockets:
        ports = []
        for _ in range(count):
            try:
                probe = open_sockets.enter_context(socket.create_server((host.strip("[]"), 0), family=_family_of(host)))
            except OSError as error:
                problem = (
                    f"{host} cannot be listened on here ({error.strerror}); give a host of this machine, or a port"
                )
                raise InvalidInputError("transport.listen", [problem]) from None
            ports.append(int(probe.getsockname()[1]))
        return ports


def _family_of(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if host.startswith("[") else socket.AF_INET
