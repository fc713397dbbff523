"""One seeded history of faults of the toy: whatever goes wrong for a while, with scans meanwhile, and then nothing."""

from __future__ import annotations

from functools import partial

import numpy as np

from tests.support.toy_estimation import toy_numbers
from tests.support.toy_rounds import TRAVEL_S, TREES, RoundsMessage, ToyBus

FAULTS_S = 4.0
PATIENCE_S = 15.0  # afterwards
MOST_CHATTER = 40  # messages on one link in 2 s of rest: four in a heartbeat


def live_through(seed: int) -> ToyBus:
    """Draw a history and live through it until all is well."""
    with toy_numbers():
        rng = np.random.default_rng(seed)
        bus = ToyBus(str(rng.choice(list(TREES))))
        severity = float(rng.random())
        bus.fate = partial(_draw_fate, bus, rng, *_draw_links(rng, severity, bus))
        _draw_processes(rng, severity, bus)
        _draw_cuts(rng, severity, bus)
        _draw_scans(rng, severity, bus)
        bus.run(FAULTS_S)
        bus.run_until_at_rest(PATIENCE_S)
        chatter = bus.find_chatter()
        assert chatter <= MOST_CHATTER, f"{chatter} messages in 2 s at rest"
        assert not bus.find_missing()
    return bus


def links_of(bus: ToyBus) -> list[tuple[str, str]]:
    return [(name, n.area) for name, content in bus.files.items() for n in content.area.neighbours]


def _draw_links(
    rng: np.random.Generator, severity: float, bus: ToyBus
) -> tuple[dict[tuple[str, str], float], dict[tuple[str, str], float]]:
    """Loss and longest delay of every link."""
    links = links_of(bus)
    loss = {link: float(rng.choice([0.0, 0.1, 0.3, 0.6])) if rng.random() < severity else 0.0 for link in links}
    late = {link: float(rng.choice([0.0, 0.01, 0.3])) if rng.random() < severity else 0.0 for link in links}
    return loss, late


def _draw_fate(
    bus: ToyBus,
    rng: np.random.Generator,
    loss: dict[tuple[str, str], float],
    late: dict[tuple[str, str], float],
    sender: str,
    receiver: str,
    message: RoundsMessage,
) -> float | None:
    if bus.now >= FAULTS_S:
        return TRAVEL_S
    if rng.random() < loss[sender, receiver]:
        return None
    return TRAVEL_S + late[sender, receiver] * float(rng.random()) ** 3


def _draw_window(rng: np.random.Generator) -> tuple[float, float]:
    """Half of them begin in the first exchange."""
    start = float(rng.uniform(0.0, 0.01)) if rng.random() < 0.5 else float(rng.uniform(0.0, FAULTS_S - 0.2))
    return start, min(FAULTS_S, start + float(rng.choice([0.003, 0.1, 0.8, 3.0]) * rng.uniform(0.5, 1.0)))


def _draw_processes(rng: np.random.Generator, severity: float, bus: ToyBus) -> None:
    bus.has_tokens = bool(rng.random() < 0.5)
    for name in bus.files:
        fate, (start, end) = rng.random(), _draw_window(rng)
        if fate < 0.3 * severity:
            bus.at(start, partial(bus.kill, name))
            bus.at(end, partial(bus.start, name))
        elif fate < 0.5 * severity:
            bus.at(start, partial(bus.freeze, name))
            bus.at(end, partial(bus.thaw, name))
        elif fate < 0.6 * severity:
            bus.at(start, partial(bus.lose_token, name))


def _draw_cuts(rng: np.random.Generator, severity: float, bus: ToyBus) -> None:
    """Of one direction or both."""
    for one, other in links_of(bus):
        if rng.random() < 0.3 * severity:
            directions = [(one, other)] if rng.random() < 0.5 else [(one, other), (other, one)]
            start, end = _draw_window(rng)
            bus.at(start, partial(bus.cut, *directions))
            bus.at(end, partial(bus.heal, *directions))


def _draw_scans(rng: np.random.Generator, severity: float, bus: ToyBus) -> None:
    """Readings come late, come again with other values, and of all but the last scan not at all."""
    moments = sorted(rng.uniform(0.0, FAULTS_S, int(rng.integers(0, 6))))
    for at in moments:
        names = list(bus.files)
        late = {name: float(rng.choice([0.01, 0.3, 1.5])) for name in names if rng.random() < 0.4 * severity}
        without = [name for name in names if rng.random() < 0.2 * severity and at != moments[-1]]
        bus.at(float(at), partial(bus.next_scan, late, without))
    for name in bus.files:
        if rng.random() < 0.3 * severity:
            value = float(rng.uniform(0.9, 1.1))
            bus.at(FAULTS_S + float(rng.uniform(-0.3, 0.5)), lambda name=name, v=value: bus.read(name, bus.scan, v))
