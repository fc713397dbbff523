"""The operator's commands: ``dsse meter``, ``dsse switch``, ``dsse scan`` and ``dsse stop``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from coordinator.cli.command import OPERATE, Command, command, group
from coordinator.cli.live.address import address_options
from coordinator.cli.terminal import answer, json_option, notify
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
@json_option
def off(meters: tuple[str, ...], join: Joining, as_json: bool) -> None:
    """Leave the readings of the meters out, from now on and after restarts, until `dsse meter on`.

    \b
    Example:  dsse meter off vm@22 vm@30
    """
    with join() as operator:
        _answer("meters", operator.switch_off(meters), "off", as_json)


@meter.command(cls=Command, part=OPERATE, short_help="Use the readings of meters again.")
@click.argument("meters", metavar="ID...", nargs=-1, required=True)
@operator_options
@json_option
def on(meters: tuple[str, ...], join: Joining, as_json: bool) -> None:
    """Use the readings of meters again that are off.

    \b
    Example:  dsse meter on vm@30
    """
    with join() as operator:
        _answer("meters", operator.switch_on(meters), "on", as_json)


def _answer(kind: str, areas: Mapping[str, str], state: str, as_json: bool) -> None:
    """Prints of each meter or switch, ``kind`` in the plural, the area that has it and its new ``state``."""
    text = "\n".join(printable(f"{area}: {name} is {state}") for name, area in areas.items())
    answer(as_json, {kind: {name: {"area": area, "is": state} for name, area in areas.items()}}, text)


@group(OPERATE, short_help="Tell a running system that switches are open or closed.")
def switch() -> None:
    """Tell a running system that switches are open or closed, with the operator's key.

    \b
    Example:  dsse switch open 18-33 --connect tls/192.0.2.7:7447 --keys keys
    """


@switch.command("open", cls=Command, part=OPERATE, short_help="Count switches as open.")
@click.argument("switches", metavar="ID...", nargs=-1, required=True)
@operator_options
@json_option
def open_(switches: tuple[str, ...], join: Joining, as_json: bool) -> None:
    """Count switches as open, from now on and after restarts, until `dsse switch close`.

    \b
    Example:  dsse switch open 18-33
    """
    with join() as operator:
        _answer("switches", operator.set_switches(switches, closed=False), "open", as_json)


@switch.command(cls=Command, part=OPERATE, short_help="Count switches as closed.")
@click.argument("switches", metavar="ID...", nargs=-1, required=True)
@operator_options
@json_option
def close(switches: tuple[str, ...], join: Joining, as_json: bool) -> None:
    """Count switches as closed, from now on and after restarts, until `dsse switch open`.

    \b
    Example:  dsse switch close 18-33
    """
    with join() as operator:
        _answer("switches", operator.set_switches(switches, closed=True), "closed", as_json)


@command(OPERATE, short_help="Have a running system make a scan at once.")
@operator_options
@json_option
def scan(join: Joining, as_json: bool) -> None:
    """Have the plant make a new scan at once; where gateways send the readings, all areas take the newest ones.

    \b
    Example:  dsse scan --connect tls/192.0.2.7:7447 --keys keys
    """
    with join() as operator:
        found = operator.scan()
        answer(as_json, {"run": operator.run, "effect": found}, printable(found))


@command(OPERATE, short_help="End what is left of a run, or a running system.")
@click.argument("folder", metavar="[RUN_FOLDER]", type=click.Path(path_type=Path), required=False)
@operator_options
@json_option
def stop(folder: Path | None, join: Joining, as_json: bool) -> None:
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
        _stop_run(folder, as_json)
        return
    with join() as operator:
        stopped = operator.stop()
        text = printable(f"run {operator.run}: {', '.join(stopped)} stopped")
        answer(as_json, {"run": operator.run, "stopped": stopped}, text)


def _stop_run(folder: Path, as_json: bool) -> None:
    from coordinator.lab.process_run.run_keys import remove_keys_of_dead_runs
    from coordinator.lab.process_run.stop_run import stop_run

    run, count = stop_run(folder)
    remove_keys_of_dead_runs()
    if run is None:
        text = f"{folder}: nothing to stop; the run was killed before it had started a process"
    elif count:
        text = f"run {run.id}: {count} process{'es' * (count > 1)} ended"
    else:
        text = f"run {run.id}: no process of it is left on this host"
    answer(as_json, {"run": run and run.id, "ended": count}, printable(text))
