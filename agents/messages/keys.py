"""Key expressions on the bus, all below ``dsse/v<wire version>/<run>/``; chunks are of letters, digits, ``_``, ``-``.

=====================================  ============================================================================
``area/<i>/boundary/<j>``              boundary messages of area i for neighbour j, angle-offset
``area/<i>/up/<j>``, ``down``          messages of rounds of strategy information, towards the hub and from it
``area/<i>/heartbeat/<j>``             progress of area i in its rounds, and whether it receives neighbour j
``area/<i>/admm/<j>``                  boundary messages of strategy admm
``area/<i>/load/<j>``                  load messages of area i for neighbour j
``area/<i>/state``                     the state of area i and its basis, for watchers
``area/<i>/readings``                  the readings that area i has used in a scan, for recorders
``telemetry/<i>/<gateway>``            meter readings for area i, from the plant or a gateway
``gateway/<name>``                     announcement of a gateway, for watchers
``command/<i>``                        commands of the operator to area i, or to the plant
``clock``                              time since the run began, from the coordinator, for injected faults only
``live/<role>/<name>/<incarnation>``   presence tokens of areas, plant, gateways, coordinator: one per incarnation;
                                       of areas and the plant with the split on which they work (``live_key``)
=====================================  ============================================================================
"""

import re

from agents.messages.packing import WIRE_VERSION, Incarnation
from dsse_core.errors import InvalidInputError
from dsse_core.limits import LONGEST_NAME
from dsse_core.split_identity import DIGITS, NO_SPLIT, SHOWN, SplitIdentity

NAME = re.compile(rf"[a-z0-9_-]{{1,{LONGEST_NAME}}}")
VERSION = re.compile(r"v([0-9]{1,9})")
INCARNATION = re.compile(
    rf"([0-9a-f]{{1,14}})-([0-9a-f]{{8}})(?:-([0-9a-f]{{{DIGITS}}})-([0-9a-f]{{1,10}})(?:-([0-9a-f]{{{SHOWN}}}))?)?"
)


def _root(run: str) -> str:
    return f"dsse/v{WIRE_VERSION}/{run}"


def all_of_run(run: str) -> str:
    return f"{_root(run)}/**"


def neighbour_key(run: str, sender: str, kind: str, receiver: str) -> str:
    return f"{_root(run)}/area/{sender}/{kind}/{receiver}"


def all_from_neighbours(run: str, receiver: str) -> str:
    """Key expression of the messages of all neighbours to ``receiver``, of every kind."""
    return f"{_root(run)}/area/*/*/{receiver}"


def state_key(run: str, area: str) -> str:
    return f"{_root(run)}/area/{area}/state"


def all_states(run: str) -> str:
    return state_key(run, "*")


def readings_key(run: str, area: str) -> str:
    return f"{_root(run)}/area/{area}/readings"


def all_readings(run: str) -> str:
    return readings_key(run, "*")


def telemetry_key(run: str, area: str, gateway: str = "plant") -> str:
    return f"{_root(run)}/telemetry/{area}/{gateway}"


def all_telemetry(run: str, area: str) -> str:
    """Key expression of the telemetry for ``area``, from the plant and all gateways."""
    return telemetry_key(run, area, "*")


def gateway_key(run: str, gateway: str) -> str:
    """Key on which a gateway announces itself. A watcher learns its name here, and asks for its token by that name."""
    return f"{_root(run)}/gateway/{gateway}"


def all_gateways(run: str) -> str:
    return gateway_key(run, "*")


def command_key(run: str, name: str) -> str:
    return f"{_root(run)}/command/{name}"


def all_commands(run: str) -> str:
    return command_key(run, "*")


def clock_key(run: str) -> str:
    return f"{_root(run)}/clock"


def live_key(run: str, role: str, name: str, incarnation: Incarnation, split: SplitIdentity = NO_SPLIT) -> str:
    """The key of a presence token: ``START-RANDOM``, then ``-DIGEST-TIME`` of the split on which the process works,
    then the first digits of the content of an edited file; all in hex digits, time in s.
    """
    stated = f"-{split.digest}-{int(split.time):x}" if split.digest else ""
    edited = f"-{split.edited[:SHOWN]}" if stated and split.edited else ""
    return f"{_root(run)}/live/{role}/{name}/{incarnation}{stated}{edited}"


def all_incarnations(run: str, role: str, name: str) -> str:
    """The tokens of every incarnation of ``name``."""
    return f"{_root(run)}/live/{role}/{name}/*"


def all_live(run: str) -> str:
    return all_incarnations(run, "*", "*")


def of_any_version(expression: str) -> str:
    """``expression``, which is of this wire version, for every version; processes of other versions are only named."""
    return f"dsse/*/{expression.removeprefix(f'dsse/v{WIRE_VERSION}/')}"


def version_of(key: str) -> int:
    """The wire version that a key belongs to; 0 if it is not written as versions are."""
    found = VERSION.fullmatch(key.split("/")[1])
    return int(found[1]) if found else 0


def run_of(key: str) -> str:
    """The run that a key belongs to; empty for a text that is no key."""
    return (*key.split("/", 3), "", "", "")[2]


def sender_of(key: str) -> str:
    """The area that a key of an area's own belongs to; empty for other keys."""
    chunks = key.split("/")
    return chunks[4] if len(chunks) > 4 and chunks[3] == "area" else ""


def publisher_of(key: str) -> tuple[str, str]:
    """(role, name) of the publisher on a key of an area's or a gateway's own; empty for other keys."""
    chunks = key.split("/")
    is_gateway = len(chunks) == 5 and chunks[3] == "gateway"
    return ("gateway", chunks[4]) if is_gateway else ("area", area) if (area := sender_of(key)) else ("", "")


def gateway_of(key: str, run: str, area: str) -> str:
    """The gateway that a key of the telemetry of ``area`` belongs to; empty for other keys."""
    root, _, gateway = key.rpartition("/")
    return gateway if f"{root}/" == telemetry_key(run, area, "") and NAME.fullmatch(gateway) else ""


def name_of_live(key: str) -> tuple[str, str]:
    """(role, name) of a presence token; empty for other keys."""
    chunks = key.split("/")
    return (chunks[4], chunks[5]) if len(chunks) == 7 and chunks[3] == "live" else ("", "")


def incarnation_of(key: str) -> Incarnation | None:
    """The incarnation that a presence token stands for; None if it is not written as incarnations are."""
    found = INCARNATION.fullmatch(key.rpartition("/")[2])
    return Incarnation(int(found[1], 16), int(found[2], 16)) if found else None


def split_of(key: str) -> SplitIdentity:
    """The split that a presence token states; of an edited file only the first digits of its content."""
    found = INCARNATION.fullmatch(key.rpartition("/")[2])
    return SplitIdentity(found[3], float(int(found[4], 16)), found[5] or "") if found and found[3] else NO_SPLIT


def default_run_id(scenario: str) -> str:
    """The name of a scenario, reduced to the letters that a key may contain: by default the name of its run."""
    return re.sub(r"[^a-z0-9_-]+", "-", scenario.lower())[:LONGEST_NAME].strip("-") or "run"


def choose_run_id(scenario: str, given: str | None) -> str:
    """``given``, or the default of the scenario's name.

    Raises:
        InvalidInputError: ``given`` has letters that a key may not contain.
    """
    return check_run_id(given) if given is not None else default_run_id(scenario)


def check_run_id(given: str) -> str:
    """``given``, if it may be a part of a key.

    Raises:
        InvalidInputError: it has letters that a key may not contain.
    """
    if not NAME.fullmatch(given):
        raise InvalidInputError("run", [f"{given!r} may only contain a-z, 0-9, _ and -, {LONGEST_NAME} at most"])
    return given
