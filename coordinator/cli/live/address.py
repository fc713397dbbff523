"""Address of a running system and the keys to join it: options that the commands in this folder share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coordinator.cli.terminal import (
    bus_timeout_option,
    choose_endpoints,
    connect_option,
    direct_option,
    keys_option,
    run_option,
)


@dataclass(frozen=True)
class RunAddress:
    """Address of a run. ``endpoints``: of routers; with ``direct`` those of all areas, without a router.

    ``run``: its name; None: the run that the keys name, or the only one on the bus. ``timeout_s``: limit for an
    endpoint to answer, and for a run to appear. ``keys``: folder of credentials.
    """

    endpoints: Sequence[str]
    run: str | None
    timeout_s: float
    keys: Path | None = None
    direct: bool = False


def address_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--connect``, ``--direct``, ``--keys``, ``--run`` and ``--timeout`` as one ``address``."""

    @connect_option()
    @direct_option
    @keys_option
    @run_option
    @bus_timeout_option
    @functools.wraps(command)
    def with_address(
        *arguments: Any,
        endpoints: tuple[str, ...],
        direct: bool,
        keys: Path | None,
        run_id: str | None,
        timeout: float,
        **options: Any,
    ) -> Any:
        chosen = choose_endpoints(endpoints, keys is not None)
        return command(*arguments, address=RunAddress(chosen, run_id, timeout, keys, direct), **options)

    return with_address
