"""What links do to messages: seeded, the same in every run, and of the size that the scenario asks for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from agents.messages.boundary_arrays import read_triangle
from agents.messages.packing import (
    DownMessage,
    Header,
    HeartbeatMessage,
    Incarnation,
    LoadMessage,
    Message,
    UpMessage,
    decode,
    encode,
)
from agents.runtime.link import FaultyLinks
from agents.runtime.link_faults import LinkFate
from agents.strategies.admm_boundary import AdmmMessage
from agents.strategies.angle_offset import BoundaryMessage
from agents.strategies.installed import load_strategy
from dsse_core.estimation.decision import Memory, Totals, decide
from dsse_core.grid.boundary import boundary_at
from dsse_core.link_faults import LinkFaults

COUNT = 4000


@pytest.fixture(autouse=True, scope="module")
def _messages_are_known() -> None:
    for name in ("admm", "angle-offset"):
        load_strategy(name)


def header(sequence: int = 1) -> Header:
    return Header("r", "a", Incarnation(1, 1), 1, sequence, 0.0)


def boundary(sequence: int = 1) -> BoundaryMessage:
    return BoundaryMessage(header(sequence), 6, 0.95, 0.1, True)


def fates_of(faults: LinkFaults, find: Callable[[LinkFate], object], count: int = COUNT, seed: int = 1) -> list[object]:
    """What ``find`` says of each of ``count`` messages of a link from a to b."""
    fate = LinkFate(faults, seed, "a", "b")
    found = []
    for _ in range(count):
        fate.next()
        found.append(find(fate))
    return found


def links(faults: LinkFaults, arrived: list[tuple[str | None, bytes]], seed: int = 1) -> FaultyLinks:
    return FaultyLinks("a", {"b": faults}, seed, lambda to, kind, payload: arrived.append((to, payload)))


def send(faults: LinkFaults, messages: list[Message], every_s: float = 0.0) -> tuple[list[Message], FaultyLinks]:
    """What arrives of ``messages``, one sent every ``every_s``, and the link afterwards."""
    arrived: list[tuple[str | None, bytes]] = []
    link = links(faults, arrived)
    for k, message in enumerate(messages):
        link.release(k * every_s)
        link.send(message, "b", k * every_s)
    link.release(1e9)
    return [decode(payload) for _, payload in arrived], link


def test_bursts_have_the_share_and_the_mean_length_that_are_asked_for():
    """A share enter / (enter + leave) of messages is in bursts; runs of them are 1 / leave long on average.

    Bounds: five standard deviations of the mean of about 4000 * 0.05 * 0.8 bursts, geometric with mean 5.
    """
    bad = fates_of(LinkFaults(burst_enter=0.05, burst_leave=0.2), lambda fate: fate.bad, count=20_000)
    bursts = sum(later and not earlier for earlier, later in pairwise(bad))
    assert sum(map(bool, bad)) / len(bad) == pytest.approx(0.2, abs=5 * (0.2 * 0.8 * 9 / 20_000) ** 0.5)
    assert sum(map(bool, bad)) / bursts == pytest.approx(5.0, abs=5 * (20 / bursts) ** 0.5)


def test_losses_inside_and_outside_bursts_are_distinguished():
    faults = LinkFaults(loss=0.1, burst_enter=0.2, burst_leave=0.2, burst_loss=0.9)
    counts = Counter(fates_of(faults, lambda fate: fate.find_loss()))
    assert counts["lost in a burst"] / (0.5 * COUNT) == pytest.approx(0.9, abs=0.1)
    assert counts["lost"] / (0.5 * COUNT) == pytest.approx(0.1, abs=0.04)


@pytest.mark.parametrize(
    "faults",
    [
        LinkFaults(burst_enter=0.2, burst_leave=0.3),
        LinkFaults(jitter_s=0.5),
        LinkFaults(duplicate=0.3),
        LinkFaults(corrupt=0.5),
    ],
)
def test_the_same_seed_gives_the_same_fates_and_another_one_others(faults: LinkFaults):
    def fate_of(fate: LinkFate) -> object:
        return fate.find_loss(), fate.copies(b"a payload of some length")

    assert fates_of(faults, fate_of, 200) == fates_of(faults, fate_of, 200)
    assert fates_of(faults, fate_of, 200) != fates_of(faults, fate_of, 200, seed=2)


def test_a_fate_depends_on_the_number_of_the_message_and_not_on_what_befell_others():
    """Other faults of the same link draw numbers of their own."""
    calm = fates_of(LinkFaults(loss=0.3), lambda fate: fate.find_loss())
    wild = fates_of(LinkFaults(loss=0.3, jitter_s=1.0, duplicate=0.5, corrupt=0.5), lambda fate: fate.find_loss())
    assert calm == wild


def test_a_delayed_message_waits_until_it_is_due_and_not_longer():
    arrived: list[tuple[str | None, bytes]] = []
    link = links(LinkFaults(delay_s=0.5), arrived)
    link.send(boundary(), "b", now=10.0)
    assert (arrived, link.next_due()) == ([], 10.5)
    link.release(10.4)
    assert arrived == []
    link.release(10.5)
    assert (len(arrived), link.next_due()) == (1, float("inf"))
    assert link.met == {"delayed": 1}


def test_jitter_makes_messages_overtake_each_other_and_all_arrive():
    sent = [boundary(k) for k in range(1, 200)]
    arrived, link = send(LinkFaults(jitter_s=1.0), sent, every_s=0.1)
    assert arrived != sent
    assert sorted(m.header.sequence for m in arrived) == [m.header.sequence for m in sent]
    assert link.met["overtaken"] > 0


def test_duplicates_arrive_twice():
    arrived, link = send(LinkFaults(duplicate=0.5), [boundary(k) for k in range(COUNT)])
    twice = [count for count in Counter(m.header.sequence for m in arrived).values() if count == 2]
    assert len(twice) == link.met["duplicated"] == len(arrived) - COUNT
    assert len(twice) / COUNT == pytest.approx(0.5, abs=5 * 0.5 / COUNT**0.5)


def test_damage_changes_every_payload_that_it_befalls_by_bytes_or_by_length():
    payload = encode(boundary())
    damaged = [copies[0][1] for copies in fates_of(LinkFaults(corrupt=1.0), lambda fate: fate.copies(payload), 500)]
    assert payload not in damaged
    shorter = [content for content in damaged if len(content) < len(payload)]
    assert 0 < len(shorter) < 500
    flipped = [
        sum(a != b for a, b in zip(content, payload, strict=True)) for content in damaged if content not in shorter
    ]
    assert {1, 2, 3} >= set(flipped) > {1}


def test_a_cut_lets_nothing_pass_in_its_window_once_the_run_has_begun():
    arrived: list[tuple[str | None, bytes]] = []
    link = links(LinkFaults(cuts=((1.0, 2.0),)), arrived)
    link.send(boundary(1), "b", now=11.5)  # nobody has said when the run began
    link.begin(10.0)
    for k, now in enumerate((10.5, 11.0, 11.9, 12.0), start=2):
        link.send(boundary(k), "b", now)
    assert [decode(payload).header.sequence for _, payload in arrived] == [1, 2, 5]
    assert (link.lost, dict(link.met)) == (2, {"lost in a cut": 2})


def test_after_until_nothing_befalls_a_message_any_more():
    link = links(LinkFaults(loss=1.0, until_s=3.0), arrived := [])
    link.begin(10.0)
    link.send(boundary(1), "b", 12.9)
    link.send(boundary(2), "b", 13.0)
    assert [decode(payload).header.sequence for _, payload in arrived] == [2]


def test_load_messages_are_biased_scaled_or_frozen_and_nothing_else_is():
    loads = [LoadMessage(header(k), 6, (0.1 * k,), (0.05,), (0.01,)) for k in (1, 2)]
    arrived, link = send(LinkFaults(load_p=0.3, load_q=-0.1, load_scale=2.0), [*loads, boundary()])
    assert [(m.p, m.q) for m in arrived[:2]] == [((0.5,), (0.0,)), ((0.7,), (0.0,))]
    assert arrived[2] == boundary()
    assert link.met == {"load changed": 2}
    frozen, _ = send(LinkFaults(load_frozen=True), loads)
    assert [(m.p, m.header.sequence) for m in frozen] == [((0.1,), 1), ((0.1,), 2)]


NAMES = boundary_at((6,), "a").names
OF_ROUND = {"variables": NAMES, "revision": 0, "k": 1, "receives": True, "answers": 0.0, "received": (0, 0)}
R = np.triu(np.arange(1.0, 17.0).reshape(4, 4))
Y = np.array([0.2, 0.1, 0.98, 0.05])


def up_of(y: np.ndarray, power: tuple[float, ...] = (), totals: Totals = Totals()) -> UpMessage:  # noqa: B008
    upper, z = tuple(R[np.triu_indices(4)].tolist()), tuple((R @ y).tolist())
    return UpMessage(header(), **OF_ROUND, R=upper, z=z, no_load=(), power=power, totals=totals)


def test_a_lie_states_another_boundary_in_every_strategys_variables():
    faults = LinkFaults(lie_p=0.3, lie_q=-0.2, lie_vm=0.02, lie_va=-0.1, lie_scale=1.5)
    false = 1.5 * Y + np.array([0.3, -0.2, 0.02, -0.1])
    heartbeat = HeartbeatMessage(header(), **OF_ROUND, final=True, complete=True, y=tuple(Y))
    admm = AdmmMessage(header(), 6, 1, tuple(Y), tuple(Y), (1.0,) * 4, True, True, variables=NAMES)
    (b, i, h, a), link = send(faults, [replace(boundary(), vm=0.98, va=0.05), up_of(Y, tuple(Y[:2])), heartbeat, admm])
    np.testing.assert_allclose((b.vm, b.va), false[2:])
    np.testing.assert_allclose(np.linalg.solve(read_triangle(i.R), i.z), false)
    np.testing.assert_allclose(i.power, false[:2])
    np.testing.assert_allclose([h.y, a.r, a.r_before], [false, false, false])
    assert link.met == {"lied": 4}


def test_a_lie_of_a_boundary_at_two_buses_is_about_each_of_its_powers_and_voltages():
    names = ("s@6>a", "s@9>a", "v@6", "v@9")
    y = np.array([0.2, 0.1, 0.3, -0.1, 0.98, 0.05, 0.97, 0.04])
    false = 1.5 * y + np.array([0.3, -0.2, 0.3, -0.2, 0.02, -0.1, 0.02, -0.1])
    R = np.triu(np.arange(1.0, 65.0).reshape(8, 8))
    upper, z = tuple(R[np.triu_indices(8)].tolist()), tuple((R @ y).tolist())
    of_round = OF_ROUND | {"variables": names}
    up = UpMessage(header(), **of_round, R=upper, z=z, no_load=(), power=tuple(y[:4]), totals=Totals())
    heartbeat = HeartbeatMessage(header(), **of_round, final=True, complete=True, y=tuple(y))
    (u, h), _ = send(LinkFaults(lie_p=0.3, lie_q=-0.2, lie_vm=0.02, lie_va=-0.1, lie_scale=1.5), [up, heartbeat])
    np.testing.assert_allclose(np.linalg.solve(read_triangle(u.R), u.z), false)
    np.testing.assert_allclose(u.power, false[:4])
    np.testing.assert_allclose(h.y, false)


@pytest.mark.parametrize("y", np.random.default_rng(1).normal(size=(20, 4)))
def test_a_lie_of_the_boundary_is_a_change_of_variables_and_so_never_contradicts_itself(y: np.ndarray):
    """|R y - z| of any y is |R' y' - z'| of the y' that the liar means by it."""
    faults = LinkFaults(lie_p=0.3, lie_vm=0.02, lie_va=-0.1, lie_scale=1.5)
    (i,), _ = send(faults, [up_of(Y)])
    false = 1.5 * y + np.array([0.3, 0.0, 0.02, -0.1])
    np.testing.assert_allclose(read_triangle(i.R) @ false - i.z, R @ (y - Y), atol=1e-12)


def test_a_verdict_follows_from_the_totals_that_are_reported_also_in_a_repeat_and_in_a_new_term():
    faults = LinkFaults(lie_objective=100.0, lie_areas=7)
    memory, false_memory, messages, expected = Memory(), Memory(), [], []
    steps = (1e-3, 1e-6, 1e-12)
    for k, step in enumerate((0.0, *steps)):
        totals = Totals(objective=5.0, degrees_of_freedom=9, dvm=step, areas=3, silent=("area2",), referenced=True)
        memory, verdict = decide(memory, totals)
        fields = {**OF_ROUND, "k": k, "R": (), "z": (), "no_load": (), "power": (), "totals": totals}
        down = DownMessage(header(), **fields, verdict=str(verdict), decider="a", incarnation=(1, 1))
        false_memory, verdict = decide(false_memory, replace(totals, objective=500.0, areas=7, silent=()))
        messages += [down, down]
        expected += [str(verdict)] * 2
    messages += [replace(m, revision=1) for m in messages]
    found, _ = send(faults, messages)
    assert [m.verdict for m in found] == expected * 2
    assert "evaluate after a last step" in expected  # the true totals end in peace
    assert all((m.totals.objective, m.totals.areas, m.totals.silent) == (500.0, 7, ()) for m in found)


def test_a_lie_about_a_verdict_or_a_meter_leaves_the_rest_as_it_is():
    fields = {**OF_ROUND, "k": 0, "R": (), "z": (), "no_load": (), "power": (), "totals": Totals(areas=3)}
    down = DownMessage(header(), **fields, verdict="step", decider="a", incarnation=(1, 1))
    (lie,), _ = send(LinkFaults(lie_verdict="final"), [down])
    assert lie == replace(down, verdict="final")
    (lie,), _ = send(LinkFaults(lie_worst="vm@16"), [up_of(Y, totals=Totals(areas=1))])
    assert lie.totals == Totals(areas=1, worst=(("vm@16", 1e3),))


def test_who_lies_of_all_areas_says_that_its_side_is_complete():
    heartbeat = HeartbeatMessage(header(), **OF_ROUND, final=True, complete=False, y=())
    (false,), link = send(LinkFaults(lie_areas=3), [heartbeat])
    assert false == replace(heartbeat, complete=True)
    assert link.met == {"lied": 1}
