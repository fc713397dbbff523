"""The keys that a watcher of a run subscribes to.

Presence tokens are asked for by name, never by a wildcard, whether or not the watcher knows the areas. A router
compares each wildcard of any session with each key of any token. When a process with many such keys leaves, no message
passes for seconds (docs/explanation/reliability.md). So a watcher that does not know the areas subscribes to the states
of areas and the announcements of gateways, and asks for the presence of the publishers.
"""

from __future__ import annotations

import queue
from collections import Counter
from collections.abc import Callable, Collection, Iterable

from agents.messages.keys import (
    NAME,
    all_commands,
    all_incarnations,
    all_readings,
    all_states,
    command_key,
    of_any_version,
    readings_key,
    state_key,
)
from agents.security.access import COORDINATOR, PLANT
from agents.transport.zenoh_bus import Session

ALWAYS = (("plant", PLANT), ("coordinator", COORDINATOR))  # (role, name) of processes that a run has once at most
NAMED_BY_NEIGHBOUR = "named"  # an area without a received message that another area names as its neighbour
# Kind of process -> number of names that are learned from the bus, in order of arrival.
MOST_ASKED = {"area": 1000, NAMED_BY_NEIGHBOUR: 1000, "gateway": 100}


def state_keys(run: str, areas: Collection[str] | None) -> tuple[str, ...]:
    """Keys of the states of ``areas``, or of all areas."""
    return (all_states(run),) if areas is None else tuple(state_key(run, area) for area in sorted(areas))


def readings_keys(run: str, areas: Collection[str] | None) -> tuple[str, ...]:
    """Keys of the readings that ``areas``, or all areas, have used."""
    return (all_readings(run),) if areas is None else tuple(readings_key(run, area) for area in sorted(areas))


def command_keys(run: str, areas: Collection[str] | None) -> tuple[str, ...]:
    """Keys of the operator's commands to ``areas`` and the plant, or to all."""
    return (all_commands(run),) if areas is None else tuple(command_key(run, name) for name in (*sorted(areas), PLANT))


def processes_of(areas: Collection[str] | None) -> tuple[tuple[str, str], ...]:
    """(role, name) of the processes whose presence is asked for from the start."""
    return (*(("area", area) for area in sorted(areas or ())), *ALWAYS)


class PresenceByName:
    """Asks for tokens and leave messages of processes of ``run``, each by its name and once.

    ``on_token(key, alive)`` and ``on_leave(key, payload)`` get tokens and leave messages. ``any_version``: those of
    other wire versions as well, which the access rules of keys let no session see.
    """

    def __init__(
        self,
        session: Session,
        run: str,
        on_token: Callable[[str, bool], None],
        on_leave: Callable[[str, bytes], None],
        *,
        any_version: bool = False,
    ) -> None:
        self._session, self._run, self._any_version = session, run, any_version
        self._on_token, self._on_leave = on_token, on_leave
        self._known = set[tuple[str, str]]()  # (role, name)
        self._counts = Counter[str]()
        self._noted = queue.SimpleQueue[tuple[str, str]]()

    def note(self, role: str, name: str, kind: str | None = None) -> None:
        """Note a process, on any thread; the next ``ask_noted`` asks for it.

        ``kind``: a key of ``MOST_ASKED``, its role if not given; processes of other kinds are not noted.
        """
        kind = kind or role
        is_new = (role, name) not in self._known and self._counts[kind] < MOST_ASKED.get(kind, 0)
        if is_new and NAME.fullmatch(name):
            self._known.add((role, name))
            self._counts[kind] += 1
            self._noted.put((role, name))

    def ask_noted(self) -> bool:
        """Ask for the processes noted; True if there were any."""
        noted = [self._noted.get_nowait() for _ in range(self._noted.qsize())]
        self.ask(noted)
        return bool(noted)

    def ask(self, processes: Iterable[tuple[str, str]]) -> None:
        """Ask for ``processes``, (role, name) each."""
        for role, name in processes:
            self._known.add((role, name))
            expression = all_incarnations(self._run, role, name)
            self._session.subscribe(expression, self._on_leave)
            asked = of_any_version(expression) if self._any_version else expression
            self._session.watch_presence(asked, self._on_token)
