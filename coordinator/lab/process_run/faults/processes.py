"""Steps of a fault schedule, carried out on real processes."""

from __future__ import annotations

from agents.security.access import PLANT
from coordinator.lab.plant.plant import RESUME, SILENT
from coordinator.lab.process_run.system import System
from scenarios.faults.schedule import Step


def do_to_processes(system: System, step: Step) -> None:
    """Carries out one step on the processes of ``system``. Steps of links do nothing here."""
    name = step.names[0]
    match step.kind:
        case "kill":
            system.kill(name)
        case "restart":
            system.restart(name)
        case "pause":
            system.pause(name)
        case "resume":
            system.go_on(name)
        case "silent":
            system.launcher.signal(PLANT, SILENT)
        case "speak":
            system.launcher.signal(PLANT, RESUME)
        case _:
            pass  # the agents of the two areas cut and heal their link by the times in their area files
