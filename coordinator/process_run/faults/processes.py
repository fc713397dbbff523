"""What a scenario does to processes, done to real ones."""

from __future__ import annotations

from agents.security.access import PLANT
from coordinator.plant.plant import RESUME, SILENT
from coordinator.process_run.faults.schedule import Step
from coordinator.process_run.system import System


def do_to_processes(system: System, step: Step) -> None:
    """Have one step happen to the processes of ``system``."""
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
            pass  # the links of the two areas know from their area files when they are cut
