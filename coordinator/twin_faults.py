"""What a scenario does to processes, done to the twin."""

from __future__ import annotations

from coordinator.fault_schedule import Step
from coordinator.twin import SimulatedBus


def do_to_twin(bus: SimulatedBus, step: Step) -> None:
    """Have one step happen on ``bus``; cuts are the links' own business.

    A plant that is dead or frozen is one that says nothing: its readings are the same afterwards. Nothing passes a
    frozen router, which nobody is told of; where a dead one is missed, so is everybody's presence.
    """
    name = step.names[0]
    match step.kind, name:
        case "kill" | "pause" | "silent", "plant":
            bus.plant_speaks = False
        case "restart" | "resume" | "speak", "plant":
            bus.plant_speaks = True
        case "kill", "router":
            bus.stop_router()
        case "restart", "router":
            bus.stop_router()
            bus.start_router()
        case "pause" | "resume", "router":
            bus.router_runs = step.kind == "resume"
        case "kill", _:
            bus.kill(name)
        case "restart", _:
            bus.kill(name)
            bus.start(name)
        case "pause", _:
            bus.pause(name)
        case "resume", _:
            bus.resume(name)
