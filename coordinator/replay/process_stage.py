"""A recording on processes: a router and agents of its own, to which the replay is the plant."""

from __future__ import annotations

import contextlib
import secrets
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from agents.area_files.area_file import AreaFile, save_area_file
from agents.messages.checks import MessageError
from agents.messages.keys import all_incarnations, all_states, sender_of, telemetry_key
from agents.messages.packing import StateMessage, decode, encode
from agents.protocol.quality import GOOD
from agents.runtime.presence import Presence, begin_incarnation
from agents.security.access import ROUTER
from agents.transport.zenoh_bus import Session, TransportError
from coordinator.process_run.fork_server import Ended, Started
from coordinator.process_run.processes import Launcher, Updates, describe_end, read_end
from coordinator.replay.replay import is_at_rest, make_telemetry_message
from coordinator.replay.ticks import Tick

START_S = 60.0  # for a router to listen and for agents to join; a busy machine takes its time
LONGEST_SCAN_S = 30.0
QUIET_S = 3.0  # after which a state that is not good stays so
STEP_S = 0.002
NICE = 10
ANY_PORT = "tcp/127.0.0.1:0"


class ProcessStage:
    """Plays scans to processes of ``files``, which begin and end with its block.

    ``endpoint``: where their router listens. ``on_state``: called with every state that comes, and when, s since 1970.
    """

    def __init__(
        self,
        files: Sequence[AreaFile],
        listen: str = ANY_PORT,
        on_state: Callable[[float, StateMessage], None] = lambda at, state: None,
    ) -> None:
        self.run = f"replay-{secrets.token_hex(4)}"
        self.endpoint = ""
        self._files = {content.area.name: content for content in files}
        self._beat_s = min(content.beat_s for content in files)
        self._listen = listen
        self._on_state = on_state
        self._incarnation = begin_incarnation()
        self._updates = Updates()
        self._presence = Presence()
        self._stack = ExitStack()
        self._payloads: dict[str, bytes] = {}  # area -> its readings, repeated as a plant does
        self._publishers: dict[str, Callable[[bytes], None]] = {}
        self._over = threading.Event()
        self._best: dict[str, StateMessage] = {}  # of this scan: the last good state, else the last
        self._changed_at = 0.0
        self._scan = 0
        self._expected: set[str] = set()  # areas that are to end

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dsse-replay-")))
            self._launcher = stack.enter_context(Launcher(self._updates.put))
            self._start_router()
            self._session = stack.enter_context(Session.connect([self.endpoint], START_S))
            self._join()
            for name in self._files:
                self._start(name)
            repeating = threading.Thread(target=self._repeat, name="repeats of readings", daemon=True)
            repeating.start()
            stack.callback(repeating.join)
            stack.callback(self._over.set)
            self._wait_for_areas(self._files.keys())
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def play(self, tick: Tick) -> Mapping[str, StateMessage]:
        """As ``Stage.play``; areas without readings are not there meanwhile.

        Raises:
            TransportError: a process has died.
        """
        self._have_there(tick.readings.keys())
        self._best, self._scan = {}, tick.scan
        now = time.time()
        for name, snapshot in tick.readings.items():
            message = make_telemetry_message(self.run, name, tick.scan, snapshot, self._incarnation, now)
            self._payloads[name] = payload = encode(message)
            self._publishers[name](payload)
        self._changed_at = began = time.monotonic()
        while time.monotonic() - began < LONGEST_SCAN_S:
            self._take(STEP_S)
            if is_at_rest((self._best.get(name) for name in tick.readings), tick.scan):
                break
            if time.monotonic() - self._changed_at > QUIET_S:
                break
        return dict(self._best)

    def _start_router(self) -> None:
        said = self._folder / "endpoints"
        options = ["--listen", self._listen, "--endpoints-file", str(said)]
        self._order(ROUTER, "coordinator.process_run.router_process:main", options, stop_last=True)
        deadline = time.monotonic() + START_S
        while not said.exists():
            self._take(STEP_S)
            if time.monotonic() > deadline:
                raise TransportError(f"the router has not opened {self._listen} within {START_S:g} s")
        self.endpoint = said.read_text(encoding="utf-8").split()[0]

    def _join(self) -> None:
        session, run = self._session, self.run
        self._publishers = {name: session.publisher(telemetry_key(run, name)) for name in self._files}
        session.subscribe(all_states(run), lambda key, payload: self._updates.offer((key, payload)))
        tokens = all_incarnations(run, "area", "*")
        session.watch_presence(tokens, lambda key, alive: self._updates.put((key, alive)))

    def _start(self, name: str) -> None:
        """Start the agent of area ``name``."""
        path = self._folder / f"{name}.json"
        if not path.exists():
            content = replace(self._files[name], run=self.run, endpoints=(self.endpoint,), listen=())
            save_area_file(path, content)
        self._expected.discard(name)
        self._order(name, "agents.__main__:run_process", path, None, nice=NICE)

    def _order(self, name: str, target: str, *arguments: object, stop_last: bool = False, nice: int = 0) -> None:
        self._launcher.start(name, target, *arguments, log=self._log_of(name), stop_last=stop_last, nice=nice)

    def _log_of(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _have_there(self, names: Iterable[str]) -> None:
        """Have the areas ``names`` there, and no others."""
        wanted = set(names)
        there = {name for _, name in self._presence.names}
        for name in there - wanted:
            self._expected.add(name)
            self._payloads.pop(name, None)
            self._launcher.signal(name, signal.SIGTERM)
        for name in wanted - there:
            self._start(name)
        self._wait_for_areas(wanted)

    def _wait_for_areas(self, names: Iterable[str]) -> None:
        wanted, deadline = set(names), time.monotonic() + START_S
        while {name for _, name in self._presence.names} != wanted:
            self._take(STEP_S)
            if time.monotonic() > deadline:
                raise TransportError(f"the areas of the replay have not joined within {START_S:g} s")

    def _take(self, wait_s: float) -> None:
        """Take in what arrives within ``wait_s``."""
        for item in self._updates.take(wait_s):
            match item:
                case (str() as key, bool() as alive):
                    self._presence.take(key, alive)
                case (str() as key, bytes() as payload):
                    self._take_state(key, payload)
                case Ended(name, _, code) if name not in self._expected:
                    end = read_end(self._log_of(name))
                    raise TransportError(f"{name} of the replay died with {describe_end(code)}:\n{end}")
                case Started() | Ended():
                    pass

    def _take_state(self, key: str, payload: bytes) -> None:
        with contextlib.suppress(MessageError):
            state = decode(payload)
            if not isinstance(state, StateMessage) or state.header.sender != sender_of(key):
                return
            self._on_state(time.time(), state)
            name, last = state.header.sender, self._best.get(state.header.sender)
            if state.header.scan != self._scan:
                return
            if last is None or last.header.order != state.header.order or last.quality != state.quality:
                self._changed_at = time.monotonic()
            if last is None or state.quality == GOOD or last.quality != GOOD:
                self._best[name] = state

    def _repeat(self) -> None:
        while not self._over.wait(self._beat_s):
            for name, payload in list(self._payloads.items()):
                self._publishers[name](payload)
