"""The operator's commands: ``dsse meter``, ``dsse scan`` and ``dsse stop``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from coordinator.cli.command import OPERATE, Command, command, group
from coordinator.cli.live.address import address_options
from coordinator.cli.terminal import notify, show
from coordinator.watch.interrupts import end_orderly_on_signals
from coordinator.watch.observe.run_address import RunAddress
from dsse_core.printable import printable

if TYPE_CHECKING:  # the real import stands in the commands, so that every other starts fast
    from coordinator.field.operate.operator import Operator

Joining = Callable[[], "AbstractContextManager[Operator]"]
UNSECURED = "without --keys any process on this bus can do the same"


def operator_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options for the address of the system. The command receives ``join``, which joins it as its operator."""

    @address_options
    @functools.wraps(command)
    def with_operator(*arguments: Any, address: RunAddress, **options: Any) -> Any:
        @contextmanager
        def join() -> Iterator[Operator]:
            from coordinator.field.operate.operator import operate

            end_orderly_on_signals()
            if address.keys is None:
                notify(UNSECURED)
            with operate(address) as operator:
                if operator.absent:
                    notify(f"not on the bus, and not reached: {', '.join(operator.absent)}")
                yield operator

        return command(*arguments, join=join, **options)

    return with_operator


@group(OPERATE, short_help="Switch meters of a running system off and on.")
def meter() -> None:
    """Switch meters of a running system off and on, with the operator's key.

    \b
    Example:  dsse meter off vm@30 --connect tls/192.0.2.7:7447 --keys keys
    """


@meter.command(cls=Command, part=OPERATE, short_help="Leave the readings of meters out.")
@click.argument("meters", metavar="ID...", nargs=-1, required=True)
@operator_options
def off(meters: tuple[str, ...], join: Joining) -> None:
    """Leave the readings of the meters out, from now on and after restarts, until `dsse meter on`.

    \b
    Example:  dsse meter off vm@22 vm@30
    """
    with join() as operator:
        for name, area in operator.switch_off(meters).items():
            show(printable(f"{area}: {name} is off"))


@meter.command(cls=Command, part=OPERATE, short_help="Use the readings of meters again.")
@click.argument("meters", metavar="ID...", nargs=-1, required=True)
@operator_options
def on(meters: tuple[str, ...], join: Joining) -> None:
    """Use the readings of meters again that are off.

    \b
    Example:  dsse meter on vm@30
    """
    with join() as operator:
        for name, area in operator.switch_on(meters).items():
            show(printable(f"{area}: {name} is on"))


@command(OPERATE, short_help="Have a running system make a scan at once.")
@operator_options
def scan(join: Joining) -> None:
    """Have the plant make a new scan at once; where gateways send the readings, all areas take the newest ones.

    \b
    Example:  dsse scan --connect tls/192.0.2.7:7447 --keys keys
    """
    with join() as operator:
        show(printable(operator.scan()))


@command(OPERATE, short_help="End what is left of a run, or a running system.")
@click.argument("folder", metavar="[RUN_FOLDER]", type=click.Path(path_type=Path), required=False)
@operator_options
def stop(folder: Path | None, join: Joining) -> None:
    """End the processes of the run in RUN_FOLDER that are left on this host, as after `kill -9` of its `dsse run`.

    With --connect in its place: end the areas and the plant of the system there, on all its hosts.

    \b
    Examples:  dsse stop runs/ieee33-20261122-120000
               dsse stop --connect tls/192.0.2.7:7447 --keys keys
    """
    is_connected = click.get_current_context().get_parameter_source("endpoints") is not ParameterSource.DEFAULT
    if (folder is None) == (not is_connected):
        raise click.UsageError("give either RUN_FOLDER, or with --connect where the system is that is to end")
    if folder is not None:
        _stop_run(folder)
        return
    with join() as operator:
        show(printable(f"run {operator.run}: {', '.join(operator.stop())} stopped"))


def _stop_run(folder: Path) -> None:
    from coordinator.lab.process_run.run_keys import remove_keys_of_dead_runs
    from coordinator.lab.process_run.stop_run import stop_run

    run, count = stop_run(folder)
    remove_keys_of_dead_runs()
    if run is None:
        show(printable(f"{folder}: nothing to stop; the run was killed before it had started a process"))
    elif count:
        show(printable(f"run {run.id}: {count} process{'es' * (count > 1)} ended"))
    else:
        show(printable(f"run {run.id}: no process of it is left on this host"))
