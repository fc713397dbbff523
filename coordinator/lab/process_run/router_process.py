"""The router as a small process, ``python -m coordinator.lab.process_run.router_process``; all others connect to it."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from agents.runtime.inbox import Inbox
from agents.runtime.log import start_log
from agents.runtime.renewal import Renewal, on_hangup
from agents.runtime.watchdog import Watchdog
from agents.security.access import ROUTER, Access
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Router
from dsse_core.errors import DsseError

AWAKE_S = 0.2  # a signal that a thread of Zenoh has caught is acted on when this thread wakes


def main(argv: Sequence[str] | None = None, access: Access | None = None) -> int:
    """Runs a router until SIGTERM or Ctrl-C. Returns 0 after an orderly end, 2 if it cannot listen.

    ``access``: the processes of the run and what they may publish, if they are known and the run has no keys. The
    router then passes nothing else.
    """
    arguments = _build_parser().parse_args(argv)
    start_log()
    inbox = Inbox()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: inbox.put("stop", True))
    try:
        if arguments.keys:
            on_hangup(lambda: inbox.put("renewal", Renewal.ASKED), lambda: inbox.put("stop", True))
        keys = load_keys(arguments.keys, ROUTER, arguments.run, listens=True)
        default = "tls/127.0.0.1:7447" if keys else "tcp/127.0.0.1:7447"
        listen, others = arguments.listen or [default], arguments.connect or ()
        with Router.listen(listen, keys, others, heartbeat_s=arguments.heartbeat, access=access) as router:
            print("listening on", ", ".join(router.endpoints), flush=True)
            if arguments.endpoints_file:
                _write_whole(arguments.endpoints_file, "\n".join(router.endpoints))
            watchdog = Watchdog()
            watchdog.ready(time.monotonic())
            while True not in (updates := inbox.take(min(AWAKE_S, watchdog.ping(time.monotonic())))):
                if Renewal.ASKED in updates and router.interrupt():
                    router.resume()
    except DsseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m coordinator.lab.process_run.router_process",
        description="Run the Zenoh router that agents, plant and coordinator connect to, until SIGTERM or Ctrl-C.",
        epilog="example: python -m coordinator.lab.process_run.router_process --listen tcp/0.0.0.0:7447",
    )
    parser.add_argument(
        "--listen", action="append", metavar="ENDPOINT", help="where to listen (tcp/127.0.0.1:7447); repeatable"
    )
    parser.add_argument(
        "--connect", action="append", metavar="ENDPOINT", help="another router to link with, now or later; repeatable"
    )
    parser.add_argument(
        "--endpoints-file", type=Path, metavar="FILE", help="write the real endpoints there, one a line"
    )
    parser.add_argument("--keys", type=Path, metavar="DIR", help="take TLS links only; rules of access and keys in DIR")
    parser.add_argument("--run", metavar="NAME", help="apply the rules of access to this run instead of the file's")
    parser.add_argument(
        "--heartbeat",
        type=float,
        default=0.0,
        metavar="S",
        help="heartbeat of the areas: where it is long, silence may last, too",
    )
    return parser


def _write_whole(path: Path, text: str) -> None:
    """Writes ``text`` so that a reader sees all of it or nothing."""
    draft = path.with_name(path.name + ".part")
    draft.write_text(text, encoding="utf-8")
    os.replace(draft, path)


if __name__ == "__main__":
    sys.exit(main())
