"""Options for the address of a running system and the keys to join it, for all commands that attach to one."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coordinator.cli.terminal import (
    choose_endpoints,
    connect_option,
    direct_option,
    keys_option,
    run_option,
    wait_option,
)
from coordinator.watch.observe.run_address import RunAddress


def address_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--connect``, ``--direct``, ``--keys``, ``--run`` and ``--wait`` as one ``address``."""

    @connect_option()
    @direct_option
    @keys_option
    @run_option
    @wait_option
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
