"""A recording on processes: a router and agents of its own, to which the replay is the plant."""

from __future__ import annotations

import contextlib
import secrets
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from agents.area_files.area_file import save_area_file
from agents.messages.checks import MessageError
from agents.messages.keys import all_incarnations, sender_of, state_key, telemetry_key
from agents.messages.packing import StateMessage, decode, encode
from agents.protocol.configuration import Configuration
from agents.protocol.quality import GOOD
from agents.runtime.presence import Presence, begin_incarnation
from agents.security.access import ROUTER
from agents.transport.zenoh_bus import Session, TransportError
from coordinator.lab.process_run.fork_server import Ended, Started
from coordinator.lab.process_run.processes import Launcher, describe_end, read_end
from coordinator.watch.observe.updates import Updates
from coordinator.watch.replay.replay import make_telemetry_message
from coordinator.watch.replay.scan_states import ScanStates
from coordinator.watch.replay.ticks import Tick
from dsse_core.files.drafts import draft_folder, remove_leftovers

PREFIX = "dsse-replay-"  # of the names of the folders of area files and logs
START_S = 60.0  # for a router to listen and for agents to join; a busy machine is slow
LONGEST_SCAN_S = 30.0  # to wait for states that were good when recorded
QUIET_S = 3.0  # without a better state, after which a scan that was not good when recorded has ended
STEP_S = 0.002
NICE = 10
ANY_PORT = "tcp/127.0.0.1:0"


class ProcessStage:
    """Plays scans to processes of ``files``. The processes begin and end with the block, and end with this process if
    it is killed.

    ``endpoint``: of their router. ``on_state``: called with the time, s since 1970, and the state of each message.
    """

    def __init__(
        self,
        files: Sequence[Configuration],
        listen: str = ANY_PORT,
        on_state: Callable[[float, StateMessage], None] = lambda at, state: None,
    ) -> None:
        self.run = f"replay-{secrets.token_hex(4)}"
        self.endpoint = ""
        self._files = {content.area.name: content for content in files}
        self._heartbeat_s = min(content.beat_s for content in files)
        self._listen = listen
        self._on_state = on_state
        self._incarnation = begin_incarnation()
        self._updates = Updates()
        self._presence = Presence()
        self._stack = ExitStack()
        self._payloads: dict[str, bytes] = {}  # area -> its readings, repeated as by a plant
        self._publishers: dict[str, Callable[[bytes], None]] = {}
        self._over = threading.Event()
        self._states = ScanStates(0, 0.0)
        self._ending: Counter[str] = Counter()  # area -> number of its processes that are ordered to end and still run

    def __enter__(self) -> Self:
        temporary = Path(tempfile.gettempdir()).absolute()
        remove_leftovers(temporary, PREFIX)
        with ExitStack() as stack:
            self._folder = stack.enter_context(draft_folder(temporary, PREFIX))
            self._launcher = stack.enter_context(Launcher(self._updates.put, bound=True))
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
        """Plays a scan, see ``Stage.play``. Areas without readings in it are not on the bus meanwhile.

        Raises:
            TransportError: a process has died, or an area has not joined or left in time.
        """
        self._have_there(tick.readings.keys())
        self._states = states = ScanStates(tick.scan, time.monotonic())
        now = time.time()
        for name, snapshot in tick.readings.items():
            message = make_telemetry_message(self.run, name, tick.scan, snapshot, self._incarnation, now)
            self._payloads[name] = payload = encode(message)
            self._publishers[name](payload)
        found = tick.estimates
        was_good = all(name in found and found[name].quality == GOOD for name in tick.readings)
        states.changed_at = began = time.monotonic()
        while not states.are_good(tick.readings) and time.monotonic() - began < LONGEST_SCAN_S:
            self._take(STEP_S)
            if not was_good and time.monotonic() - states.changed_at > QUIET_S:
                break
        return states.best

    def _start_router(self) -> None:
        endpoints_file = self._folder / "endpoints"
        options = ["--listen", self._listen, "--endpoints-file", str(endpoints_file)]
        self._order(ROUTER, "coordinator.lab.process_run.router_process:main", options, stop_last=True)
        deadline = time.monotonic() + START_S
        while not endpoints_file.exists():
            self._take(STEP_S)
            if time.monotonic() > deadline:
                raise TransportError(f"the router has not opened {self._listen} within {START_S:g} s")
        self.endpoint = endpoints_file.read_text(encoding="utf-8").split()[0]

    def _join(self) -> None:
        session, run = self._session, self.run
        self._publishers = {name: session.publisher(telemetry_key(run, name)) for name in self._files}
        for name in self._files:
            session.subscribe(state_key(run, name), lambda key, payload: self._updates.offer((key, payload)))
            tokens = all_incarnations(run, "area", name)
            session.watch_presence(tokens, lambda key, alive: self._updates.put((key, alive)))

    def _start(self, name: str) -> None:
        """Starts the agent of area ``name``."""
        path = self._folder / f"{name}.json"
        if not path.exists():
            content = replace(self._files[name], run=self.run, endpoints=(self.endpoint,), listen=())
            save_area_file(path, content)
        self._order(name, "agents.__main__:run_process", path, None, nice=NICE)

    def _order(self, name: str, target: str, *arguments: object, stop_last: bool = False, nice: int = 0) -> None:
        self._launcher.start(name, target, *arguments, log=self._log_of(name), stop_last=stop_last, nice=nice)

    def _log_of(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _have_there(self, names: Iterable[str]) -> None:
        """Starts and ends agents until exactly the areas ``names`` are on the bus."""
        wanted = set(names)
        there = {name for _, name in self._presence.names}
        for name in there - wanted:
            self._ending[name] += 1
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
        """Takes in the updates that arrive within ``wait_s``.

        Raises:
            TransportError: a process has died.
        """
        for item in self._updates.take(wait_s):
            match item:
                case (str() as key, bool() as alive):
                    self._presence.take(key, alive)
                case (str() as key, bytes() as payload):
                    self._take_state(key, payload)
                case Ended(name) if self._ending[name]:
                    self._ending[name] -= 1  # a new process of the area may run already
                case Ended(name, _, code):
                    end = read_end(self._log_of(name))
                    raise TransportError(f"{name} of the replay died with {describe_end(code)}:\n{end}")
                case Started():
                    pass

    def _take_state(self, key: str, payload: bytes) -> None:
        with contextlib.suppress(MessageError):
            state = decode(payload)
            if not isinstance(state, StateMessage) or state.header.sender != sender_of(key):
                return
            self._on_state(time.time(), state)
            self._states.take(time.monotonic(), state)

    def _repeat(self) -> None:
        while not self._over.wait(self._heartbeat_s):
            for name, payload in list(self._payloads.items()):
                self._publishers[name](payload)
