"""``python -m agents AREA_FILE``: the agent of one area in this process, until SIGTERM or Ctrl-C."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType

from agents.area_files.reader import load_area_file
from agents.orders.order_book import BY_OPERATOR, STOPPED_CODE, OrderBook
from agents.orders.order_file import OrderFile
from agents.protocol.configuration import Configuration
from agents.protocol.events import StopRequested
from agents.runtime.duplicate_guard import REPLACED_CODE, ReplacedError, take_place
from agents.runtime.inbox import Inbox
from agents.runtime.log import start_log
from agents.runtime.loop import run_agent
from agents.runtime.next_file import NextFile
from agents.runtime.renewal import Renewal, on_hangup
from agents.runtime.watchdog import Watchdog
from agents.security.credentials import load_keys
from agents.strategies.installed import list_strategies
from agents.transport.zenoh_bus import Session
from dsse_core import compiling, operating_system
from dsse_core.endpoints import add_protocol, check_endpoints
from dsse_core.errors import DsseError
from dsse_core.limits import LONGEST_S

TIMEOUT_S = 10.0  # of the wait for the bus
SWITCH_S = 1e-4  # after which computing yields to a thread of the bus with messages; Python's own 5 ms is many steps


def main(argv: Sequence[str] | None = None) -> int:
    """Run one agent; 0 after an orderly end, 2 on wrong input or a bus that cannot be reached, 3 if replaced, 4 if
    the operator has stopped it."""
    arguments = make_parser().parse_args(argv)
    file, keys = arguments.area_file, arguments.keys
    connect = add_protocol(arguments.connect or (), secured=keys is not None)
    return run_process(file, keys, connect, arguments.wait, may_be_older=arguments.older_file)


def make_parser() -> argparse.ArgumentParser:
    """The command line of ``dsse agent``."""
    parser = argparse.ArgumentParser(
        prog="dsse agent",
        description="Run the agent of one area until SIGTERM or Ctrl-C. `dsse split` writes the area files.",
        epilog="example: dsse agent runs/split/area1.toml --connect tcp/192.0.2.7:7447",
    )
    parser.add_argument("area_file", type=Path, help="the area's file: network, meters, neighbours, endpoints")
    parser.add_argument(
        "--connect",
        action="append",
        metavar="HOST:PORT",
        help="endpoint to use instead of the file's; repeatable",
    )
    parser.add_argument(
        "--keys", type=Path, metavar="DIR", help="show the certificate of the area in DIR (`dsse keys create`)"
    )
    parser.add_argument("--wait", type=_seconds, default=TIMEOUT_S, metavar="S", help="wait for the bus so long (10 s)")
    parser.add_argument("--timeout", type=_refuse_timeout, help=argparse.SUPPRESS)
    parser.add_argument(
        "--older-file", action="store_true", help="take the place of a running agent of the area with a newer file, too"
    )
    return parser


def run_process(
    path: Path,
    keys: Path | None = None,
    endpoints: Sequence[str] = (),
    timeout_s: float = TIMEOUT_S,
    *,
    may_be_older: bool = False,
) -> int:
    """Run ``run_area`` as the only work of this process, with a log; returns the exit code, see ``main``.

    A forked process calls this without a parser of its own, which takes 2 ms and 1.5 MiB.
    """
    start_log()
    watchdog = Watchdog()
    for listener in (_LogOfCompiling(), watchdog.take_compiling):
        compiling.listen(listener)
    try:
        reason = run_area(path, endpoints, timeout_s, keys, watchdog, may_be_older=may_be_older)
    except DsseError as error:
        print(f"error: {error}", file=sys.stderr)
        return REPLACED_CODE if isinstance(error, ReplacedError) else 2
    return STOPPED_CODE if reason == BY_OPERATOR else 0


class _LogOfCompiling:
    """Logs once that solvers are compiled, which delays the start, and where their code is kept."""

    logged = False

    def __call__(self, begins: bool, folder: str | None) -> None:
        if begins and not self.logged:
            self.logged = True
            kept = f"this happens once, the code is kept in {folder}" if folder else "no safe folder can keep it"
            logging.getLogger(__name__).info("the agent compiles the solvers of large radial areas; %s", kept)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds") from None
    if not 0 < value <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} s; a time must be positive and at most a day")
    return value


def _refuse_timeout(_: str) -> None:
    raise argparse.ArgumentTypeError("is gone; --wait S says how long to wait for the bus")


def run_area(
    path: Path,
    endpoints: Sequence[str],
    timeout_s: float,
    keys: Path | None,
    watchdog: Watchdog | None = None,
    *,
    may_be_older: bool = False,
) -> str:
    """Run the agent of area file ``path``; ``endpoints``, if any, replace the file's; ``keys``: folder of credentials.

    ``may_be_older``: the agent takes the place of a running one even if that has a newer file. Returns the reason of
    the end.

    Raises:
        InvalidInputError: the area file, the operator file or the credentials cannot be used.
        TransportError: no endpoint answers within ``timeout_s``.
        ReplacedError: another agent of the area runs, which began later or has a newer file.
    """
    check_endpoints("--connect", endpoints)
    of_file = load_area_file(path, list_strategies())
    content = replace(of_file, endpoints=tuple(endpoints)) if endpoints else of_file
    name = content.area.name
    orders = OrderBook.of(content, OrderFile.of(path, content.run, name))
    inbox = Inbox()
    sys.setswitchinterval(SWITCH_S)

    def stop(number: int, frame: FrameType | None) -> None:
        inbox.put("stop", StopRequested(signal.Signals(number).name))

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Zenoh's connecting would defer Python's handler to its end
    if keys:
        on_hangup(
            lambda: inbox.put("renewal", Renewal.ASKED), lambda: stop(operating_system.HANGUP or signal.SIGTERM, None)
        )
    with _open_session(content, timeout_s, keys) as session:
        signal.signal(signal.SIGTERM, stop)
        signal.signal(signal.SIGINT, stop)
        next_file = NextFile(path, of_file, inbox, lambda found: load_area_file(found, list_strategies()))
        following = next_file.read_at_once()
        if not may_be_older:
            take_place(content, session, following)
        reason = run_agent(content, session, inbox, watchdog, orders, next_file)
    logging.getLogger(__name__).info("area %s ends: %s", name, reason)
    return reason


def _open_session(content: Configuration, timeout_s: float, keys: Path | None) -> Session:
    """Join the bus at a router, or listen for the neighbours."""
    loaded = load_keys(keys, content.area.name, content.run, listens=bool(content.listen))
    if not content.listen:
        return Session.connect(content.endpoints, timeout_s, loaded, heartbeat_s=content.beat_s)
    return Session.meet(content.endpoints, content.listen, loaded, heartbeat_s=content.beat_s)


if __name__ == "__main__":
    sys.exit(main())
