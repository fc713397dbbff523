"""The keys of ``[faults]`` in a scenario file, as strict tables; docs/reference/scenario-files.md explains each."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from dsse_core.files.quantities import ClockError, Milliseconds, Moment, NotNegative, Positive, Probability, Seconds
from dsse_core.files.strict_table import Table
from dsse_core.limits import LONGEST_NAME

MOMENTARY = ("kill", "restart")
LASTING = ("pause", "cut", "silent")


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
    q_mvar: float = 0.0
    scale: float = 1.0
    frozen: bool = False


class LieTable(Table):
    """``lie``: changes of the content of a strategy's messages on the way."""

    p_mw: float = 0.0
    q_mvar: float = 0.0
    vm_pu: float = 0.0
    va_deg: float = 0.0
    scale: Positive = 1.0
    both_ways: bool = False
    objective: NotNegative = 1.0
    areas: Annotated[int, Field(ge=1)] | None = None
    worst: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)
    verdict: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)


class LinkTable(Table):
    """One ``[[faults.link]]``: from the sending to the receiving area; keys not given are as in ``[faults]``."""

    from_: str = Field(alias="from", description="the area that sends")
    to: str = Field(description="the area that receives")
    loss: Probability | None = None
    burst: BurstTable | None = None
    delay_ms: Milliseconds | None = None
    jitter_ms: Milliseconds | None = None
    duplicate: Probability | None = None
    corrupt: Probability | None = None
    load: LoadFaultTable = LoadFaultTable()
    lie: LieTable = LieTable()


class LoadErrorTable(Table):
    """``[faults.load_error.NAME]``, NAME an area or ``all``."""

    p_mw: float = Field(description="MW added to the load at each boundary bus of the area")
    q_mvar: float = Field(description="Mvar added to the load at each boundary bus of the area")


class TelemetryFaultsTable(Table):
    """``[faults.telemetry]``."""

    missing: Probability = 0.0
    late: Probability = 0.0
    late_s: Seconds = 1.0


class EventTable(Table):
    """One ``[[faults.events]]``."""

    at_s: Moment = Field(description="when, s since the start of the run: all areas on the bus")
    kill: str | None = None
    restart: str | None = None
    pause: str | None = None
    cut: list[str] | None = None
    silent: Literal["plant"] | None = None
    for_s: Seconds | None = None

    @property
    def kind(self) -> str:
        """The kind of the event: the key that is given, one of five."""
        return next(kind for kind in (*MOMENTARY, *LASTING) if getattr(self, kind) is not None)

    @property
    def names(self) -> tuple[str, ...]:
        """The names concerned: one process, or the two areas of a cut."""
        value = getattr(self, self.kind)
        return tuple(value) if isinstance(value, list) else (value,)

    @model_validator(mode="after")
    def _is_one_event(self) -> Self:
        given = [kind for kind in (*MOMENTARY, *LASTING) if getattr(self, kind) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"give exactly one of kill, restart, pause, cut and silent, found {found}")
        if self.cut is not None and len(set(self.cut)) != 2:
            raise ValueError(f"cut must name two neighbouring areas, found {self.cut!r}")
        if given[0] in LASTING and self.for_s is None:
            raise ValueError(f"{given[0]} lasts; say how long with for_s")
        if given[0] in MOMENTARY and self.for_s is not None:
            raise ValueError(f"{given[0]} happens in a moment; remove for_s")
        return self


class FaultsTable(Table):
    """``[faults]``: faults of links, telemetry, load messages and clocks, and events of processes."""

    loss: Probability = Field(default=0.0, description="probability that a message is lost, 0 to 1")
    burst: BurstTable | None = None
    delay_ms: Milliseconds = 0.0
    jitter_ms: Milliseconds = 0.0
    duplicate: Probability = 0.0
    corrupt: Probability = 0.0
    until_s: Seconds | None = None
    link: list[LinkTable] = Field(default_factory=list)
    load_error: dict[str, LoadErrorTable] = Field(default_factory=dict)
    telemetry: TelemetryFaultsTable = TelemetryFaultsTable()
    clock_error_s: dict[str, ClockError] = Field(default_factory=dict)
    events: list[EventTable] = Field(default_factory=list)
