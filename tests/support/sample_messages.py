"""One message of each kind, and what stands in one when it is packed."""

from dataclasses import fields

import msgspec

from agents.messages.packing import (
    ClockMessage,
    CommandMessage,
    DownMessage,
    Header,
    HeartbeatMessage,
    Incarnation,
    LoadMessage,
    ReadingsMessage,
    StateMessage,
    TelemetryMessage,
    UpMessage,
    encode,
)
from agents.strategies.admm_boundary import AdmmMessage
from agents.strategies.angle_offset import BoundaryMessage
from agents.strategies.installed import list_strategies, load_strategy
from dsse_core.estimation.decision import Totals

for name in list_strategies():
    load_strategy(name)  # which makes its messages known

HEADER = Header("run-1", "area1", Incarnation(1_795_200_000_000, 2**32 - 1), 7, 3, 1_795_200_000.25)
STATE = StateMessage(
    header=HEADER,
    buses=(1, 2),
    vm=(1.0, 0.99),
    va=(0.0, -0.01),
    sigma_vm=(0.001, 0.002),
    sigma_va=(0.0, 0.001),
    referenced=True,
    objective=12.5,
    degrees_of_freedom=20,
    removed=("p_flow@1:1-2",),
    critical=("vm@1",),
    checked=True,
    sent={"area2": (1, 4)},
    received={"area2": (1, 3)},
    messages=12,
    bytes=800,
    lost=2,
    rejected={"malformed": 1},
    notes=("no load message from area2 yet",),
    faults={"lost": 2, "delayed": 7},
    quality="degraded",
    telemetry_age=0.25,
    ages={"area2": 1.5},
    scans={"area2": 6},
    old_sides=("area3",),
)
VARIABLES = ("s@6>area2", "v@6")
UP = UpMessage(
    HEADER,
    variables=VARIABLES,
    revision=1,
    k=3,
    receives=True,
    answers=1.7e9,
    received=(0, 2),
    R=tuple(map(float, range(10))),
    z=(0.1, 0.2, 0.3, 0.4),
    no_load=(),
    power=(0.1, 0.2),
    totals=Totals(12.5, -2, 1e-3, 2e-3, 3, (("vm@1", 4.5),), 2, True, ("area4",), (), ("7", "9-12"), ()),
)


MESSAGES = [
    LoadMessage(HEADER, 6, (0.25,), (-0.1,), (0.01,)),
    BoundaryMessage(HEADER, 6, 0.95, -0.02, True),
    AdmmMessage(
        HEADER,
        6,
        3,
        (0.1, 0.0, 1.0, -0.1),
        (0.2, 0.0, 1.0, -0.1),
        (1e4, 1e4, 1e5, 1e5),
        True,
        True,
        variables=VARIABLES,
    ),
    HeartbeatMessage(HEADER, 1, 3, True, 1.7e9, (3, 0), True, False, (0.1, 0.2, 1.0, -0.1), variables=VARIABLES),
    UP,
    DownMessage(
        **{f.name: getattr(UP, f.name) for f in fields(UP)} | {"power": ()},
        verdict="evaluate",
        decider="area1",
        incarnation=(1, 2),
    ),
    TelemetryMessage(HEADER, "area1", ("vm@1",), (1.0,), (0.002,), (1.7952e9,), (False,)),
    ReadingsMessage(HEADER, 1.7952e9, ("vm@1",), (1.0,), (0.002,), (1.7952e9 - 60,), (1.001,), (0.5,)),
    CommandMessage(HEADER, "area1", ("vm@1",), ("vm@2",), True, False),
    ClockMessage(HEADER, 12.5),
    STATE,
]


def places_of(message):
    return list(msgspec.msgpack.decode(encode(message)[:-4]))


HEADER_PLACE, VM, REFERENCED = 2, 4, 6  # of a boundary message
