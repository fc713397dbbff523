"""The keys of ``[faults]`` in a scenario file, as strict tables; docs/reference/scenario-files.md explains each."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from dsse_core.files.strict_table import Table
from dsse_core.limits import LONGEST_NAME, ClockError, Milliseconds, Moment, NotNegative, Positive, Probability, Seconds

MOMENTARY = ("kill", "restart")
LASTING = ("pause", "cut", "silent")
KINDS = (*MOMENTARY, *LASTING, "switch")


class BurstTable(Table):
    """``burst``: losses that come in bursts (Gilbert-Elliott); outside them ``loss`` counts."""

    enter: Probability = Field(description="probability that a burst begins at a message")
    leave: Annotated[float, Field(gt=0, le=1)] = Field(
        description="probability that a burst has ended at a message; 1/leave is its mean length in messages"
    )
    loss: Probability = Field(default=1.0, description="probability that a message within a burst is lost")


class LoadFaultTable(Table):
    """``load``: changes of the content of load messages on the way."""

    p_mw: float = 0.0
    """Added, shared by its phases."""
    q_mvar: float = 0.0
    """Likewise."""
    scale: float = 1.0
    """Multiplies."""
    frozen: bool = False
    """Every load message repeats the first one."""


class LieTable(Table):
    """``lie``: changes of the content of a strategy's messages on the way."""

    p_mw: float = 0.0
    """Added to the active power at the boundary, shared by its phases."""
    q_mvar: float = 0.0
    """Likewise, reactive power."""
    vm_pu: float = 0.0
    """Added to the voltage magnitude."""
    va_deg: float = 0.0
    """Added to the voltage angle."""
    scale: Positive = 1.0
    """Multiplies all four."""
    both_ways: bool = False
    """The receiver's messages are changed back, so that both sides find the other to agree; the other direction
    then has no lie of its own.
    """
    objective: NotNegative = 1.0
    """Multiplies J."""
    areas: Annotated[int, Field(ge=1)] | None = None
    """Areas counted; the side is complete, without silent or stale areas."""
    worst: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)
    """Id of the meter named as the worst."""
    verdict: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)
    """Verdict sent, e.g. `"final"`."""


class LinkTable(Table):
    """One ``[[faults.link]]``: from the sending to the receiving area; keys not given are as in ``[faults]``."""

    from_: str = Field(alias="from", description="the area that sends")
    """The area that sends."""
    to: str = Field(description="the area that receives")
    """The area that receives, a neighbour of the first."""
    loss: Probability | None = None
    """As in `[faults]`, like the next five."""
    burst: BurstTable | None = None
    delay_ms: Milliseconds | None = None
    jitter_ms: Milliseconds | None = None
    duplicate: Probability | None = None
    corrupt: Probability | None = None
    load: LoadFaultTable = LoadFaultTable()
    """Changes of load messages."""
    lie: LieTable = LieTable()
    """Changes of a strategy's messages: a lying neighbour."""


class LoadErrorTable(Table):
    """``[faults.load_error.NAME]``, NAME an area or ``all``."""

    p_mw: float = Field(description="MW added to the load at each boundary bus of the area")
    """Added to the load at each boundary bus of the area (thesis eq. 5.4)."""
    q_mvar: float = Field(description="Mvar added to the load at each boundary bus of the area")
    """Added to the load at each boundary bus of the area (thesis eq. 5.5)."""


class TelemetryFaultsTable(Table):
    """``[faults.telemetry]``."""

    missing: Probability = 0.0
    """Share of readings that a scan lacks."""
    late: Probability = 0.0
    """Probability that a scan reaches an area late."""
    late_s: Seconds = 1.0
    """Longest delay; a uniformly drawn part of it."""


class EventTable(Table):
    """One ``[[faults.events]]``."""

    at_s: Moment = Field(description="when, s since the start of the run: all areas on the bus")
    """Time of the event."""
    kill: str | None = None
    """Process that is killed (SIGKILL)."""
    restart: str | None = None
    """Process that is started again; a running one is killed first."""
    pause: str | None = None
    """Process that is stopped (SIGSTOP) for `for_s`."""
    cut: list[str] | None = None
    """Two neighbouring areas between which nothing passes for `for_s`."""
    silent: Literal["plant"] | None = None
    """The plant stays on the bus and sends nothing for `for_s`."""
    for_s: Seconds | None = None
    """Duration of `pause`, `cut` and `silent`, which need it."""
    switch: str | None = None
    """Switch of the network that is operated; the plant reads its status from the start."""
    to: Literal["open", "closed"] | None = None
    """The status of `switch` from then on."""
    status_after_s: Seconds | None = None
    """Delay of the status as the plant reads it."""
    status: Literal["open", "closed", "unknown"] | None = None
    """The status that the plant reads from then on, instead of `to`."""

    @property
    def kind(self) -> str:
        """The kind of the event: the key that is given, one of six."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def over_s(self) -> float:
        """The time at which the event is over, s."""
        return self.at_s + (self.for_s or self.status_after_s or 0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """The names concerned: one process, or the two areas of a cut."""
        value = getattr(self, self.kind)
        return tuple(value) if isinstance(value, list) else (value,)

    @model_validator(mode="after")
    def _is_one_event(self) -> Self:
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"give exactly one of kill, restart, pause, cut, silent and switch, found {found}")
        if self.cut is not None and len(set(self.cut)) != 2:
            raise ValueError(f"cut must name two neighbouring areas, found {self.cut!r}")
        if given[0] in LASTING and self.for_s is None:
            raise ValueError(f"{given[0]} lasts; say how long with for_s")
        if given[0] not in LASTING and self.for_s is not None:
            raise ValueError(f"{given[0]} happens in a moment; remove for_s")
        if self.switch is not None and self.to is None:
            raise ValueError('switch needs its status from then on: to = "open" or "closed"')
        of_switch = [key for key in ("to", "status_after_s", "status") if getattr(self, key) is not None]
        if self.switch is None and of_switch:
            raise ValueError(f"{given[0]} takes no {' nor '.join(of_switch)}, which are of a switch; remove them")
        return self


class FaultsTable(Table):
    """``[faults]``: faults of links, telemetry, load messages and clocks, and events of processes."""

    loss: Probability = Field(default=0.0, description="probability that a message is lost, 0 to 1")
    """Probability that a message is lost, on every directed link between neighbouring areas; 1 cuts all links."""
    burst: BurstTable | None = None
    """Losses in bursts."""
    delay_ms: Milliseconds = 0.0
    """Delay of every message."""
    jitter_ms: Milliseconds = 0.0
    """A uniformly drawn part is added, so that messages overtake each other."""
    duplicate: Probability = 0.0
    """Probability that a message is sent twice, each with its own delay."""
    corrupt: Probability = 0.0
    """Probability that bytes of a message are damaged: one to three flipped, or the end cut off."""
    until_s: Seconds | None = None
    """End of all faults of links, cuts apart."""
    link: list[LinkTable] = Field(default_factory=list)
    """`[[faults.link]]`: links with faults of their own."""
    load_error: dict[str, LoadErrorTable] = Field(default_factory=dict)
    """`[faults.load_error.NAME]`: errors of the boundary load."""
    telemetry: TelemetryFaultsTable = TelemetryFaultsTable()
    """Faults of telemetry."""
    clock_error_s: dict[str, ClockError] = Field(default_factory=dict)
    """Seconds by which clocks of areas are ahead, -86400 to 86400: `{ area2 = 3.0 }`."""
    events: list[EventTable] = Field(default_factory=list)
    """`[[faults.events]]`: faults of processes and links at given times."""
