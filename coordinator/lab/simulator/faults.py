"""Steps of a fault schedule, carried out on the simulator."""

from __future__ import annotations

from agents.security.access import ROUTERS
from coordinator.lab.simulator.simulator import SimulatedBus
from scenarios.faults.schedule import Step

LEASE_S = 2.0  # after which processes leave a frozen router for the other one


class SimulatorFaults:
    """Carries out the steps of a scenario on ``bus``. ``routers``: number of linked routers that carry its messages.

    A plant that is dead or frozen publishes nothing, and has the same readings afterwards. A frozen router passes no
    message, and presence tokens stay. When the last router dies, every area sees the tokens of its neighbours vanish.
    All processes are linked to the first of two routers, and move to the other one at once when it dies.
    """

    def __init__(self, bus: SimulatedBus, routers: int) -> None:
        self._bus = bus
        self._alive = list(ROUTERS[:routers])  # the first one carries all messages
        self._frozen: dict[str, float] = {}  # router -> virtual time at which it was frozen

    def do(self, step: Step) -> None:
        """Carries out one step. Cuts of links do nothing here, because the links follow the times of their files."""
        name = step.names[0]
        match step.kind, name:
            case "kill" | "pause" | "silent", "plant":
                self._bus.plant_publishes = False
            case "restart" | "resume" | "speak", "plant":
                self._bus.plant_publishes = True
            case _ if name in ROUTERS:
                self._do_to_router(step.kind, name)
            case "kill", _:
                self._bus.kill(name)
            case "restart", _:
                self._bus.kill(name)
                self._bus.start(name)
            case "pause", _:
                self._bus.pause(name)
            case "resume", _:
                self._bus.resume(name)

    def _do_to_router(self, kind: str, name: str) -> None:
        if kind in ("kill", "restart"):
            self._frozen.pop(name, None)
            if self._alive == [name]:
                self._bus.stop_router()
            self._alive = [other for other in self._alive if other != name]
        if kind == "restart":
            self._alive.append(name)
            if self._alive == [name]:
                self._bus.start_router()
        elif kind == "pause":
            self._frozen[name] = since = self._bus.now
            self._bus.at(since + LEASE_S, lambda: self._give_up(name, since))
        elif kind == "resume":
            self._frozen.pop(name, None)
        self._bus.router_runs = bool(self._alive) and self._alive[0] not in self._frozen

    def _give_up(self, name: str, since: float) -> None:
        """Moves all processes from router ``name`` to the other one, if it is still frozen since ``since``."""
        if self._frozen.get(name) == since:
            self._alive.sort(key=lambda other: other in self._frozen)
            self._bus.router_runs = self._alive[0] not in self._frozen
