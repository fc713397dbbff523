"""Two sides of one boundary: each r is used once, whatever is lost, repeated or restarted."""

from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import Header, Incarnation
from agents.strategies.admm_boundary import AdmmMessage, BoundaryIteration
from dsse_core.exchange.consensus_admm import RELAXATION
from dsse_core.grid.boundary import boundary_at
from dsse_core.grid.partition import Neighbour

BOUNDARY = boundary_at((6,), "other")
HEADER = Header("r", "a", Incarnation(1, 1), 1, 1, 0.0)


class Side:
    """An area whose only knowledge is that y is near ``target``, with three times the weight of the penalty."""

    def __init__(self, target: float, *, is_parent: bool, referenced: bool = True) -> None:
        self.boundary = BoundaryIteration(Neighbour("other", 6, is_parent=not is_parent), BOUNDARY)
        self.boundary.angle_known = referenced
        self.target = np.full(4, target)
        self.used: list[tuple[int, float]] = []
        self.boundary.set_sent(self.y)

    @property
    def y(self) -> np.ndarray:
        z = self.boundary.z
        return self.target if z is None else (3 * self.target + z) / 4

    def message(self) -> AdmmMessage:
        b = self.boundary
        sent, before = tuple(b.sent.tolist()), tuple(b.sent_before.tolist())
        of_side = tuple(b.weight.tolist()), b.unsettled, b.angle_known
        return AdmmMessage(HEADER, 6, b.k, sent, before, *of_side, variables=BOUNDARY.names)

    def take(self, message: AdmmMessage) -> int:
        """Steps taken on hearing ``message``."""
        self.boundary.received = message
        steps = 0
        while self.boundary.step(self.y):
            self.boundary.set_sent(self.y)
            steps += 1
        self.boundary.note_sent()
        return steps


def pair() -> tuple[Side, Side]:
    return Side(1.0, is_parent=True), Side(3.0, is_parent=False)


def run(owner: Side, child: Side, drop=lambda number: False) -> int:
    """Messages back and forth until nobody has anything to say; the owner repeats itself after a loss."""
    number = 0
    owner.take(child.message())
    for number in range(1, 200):
        if drop(2 * number):
            continue
        if not child.take(owner.message()) and not child.boundary.is_owed:
            break
        if not drop(2 * number + 1):
            owner.take(child.message())
    return number


def test_both_sides_end_at_the_same_y_and_their_gradients_cancel():
    owner, child = pair()
    run(owner, child)
    np.testing.assert_allclose(owner.y, 2.0, atol=1e-9)
    np.testing.assert_allclose(child.y, 2.0, atol=1e-9)
    np.testing.assert_allclose((owner.boundary.z - owner.y) + (child.boundary.z - child.y), 0.0, atol=1e-9)


def test_what_is_lost_changes_no_iterate():
    clean, lossy = pair(), pair()
    run(*clean)
    run(*lossy, drop=lambda number: number % 3 == 0)
    np.testing.assert_array_equal(lossy[0].boundary.z, clean[0].boundary.z)
    np.testing.assert_array_equal(lossy[1].boundary.z, clean[1].boundary.z)


def test_a_repeated_message_is_taken_in_once():
    owner, child = pair()
    assert owner.take(child.message()) == 1
    message = owner.message()
    assert child.take(message) == 2  # the answer and the next step
    assert child.take(message) == 0


def test_of_two_that_are_at_the_same_iteration_the_owner_goes_first():
    owner, child = pair()
    child.boundary.note_sent()
    at_zero = owner.message()
    assert child.take(at_zero) == 0
    assert child.boundary.is_owed
    assert owner.take(child.message()) == 1


def test_a_neighbour_that_is_one_ahead_is_answered_with_its_iteration_before():
    owner, child = pair()
    owner.take(child.message())
    message = owner.message()
    assert (message.iteration, message.r_before) == (1, (1.0,) * 4)
    child.boundary.received = message
    assert child.boundary.step(child.y)
    np.testing.assert_array_equal(child.boundary.z, message.r_before)  # the first z is what is received first
    assert child.boundary.k == 1


def test_a_side_that_has_restarted_goes_on_from_the_iteration_it_receives():
    owner, child = pair()
    for _ in range(5):
        owner.take(child.message())
        child.take(owner.message())
    late = child.boundary.k
    owner = Side(1.5, is_parent=True)
    assert owner.take(child.message()) >= 1
    assert owner.boundary.k >= late
    run(owner, child)
    np.testing.assert_allclose([owner.y, child.y], 2.25, atol=1e-9)


def test_the_step_is_over_relaxed():
    owner, child = pair()
    owner.take(child.message())
    z = owner.boundary.z
    child.take(owner.message())
    owner.boundary.received = child.message()
    owner.boundary.step(owner.y)
    r = np.array(child.message().r_before)
    np.testing.assert_allclose(owner.boundary.z, z + RELAXATION * (r - z))


@pytest.mark.parametrize("is_parent", [True, False])
def test_a_side_that_knows_no_angle_takes_that_of_the_other_and_pulls_nothing(is_parent):
    knowing = Side(1.0, is_parent=is_parent, referenced=True)
    ignorant = Side(3.0, is_parent=not is_parent, referenced=False)
    assert ignorant.boundary.find_turn(ignorant.y) == 0.0
    ignorant.take(knowing.message())
    assert ignorant.boundary.find_turn(ignorant.target) == 1.0 - 3.0
    knowing.take(ignorant.message())
    assert knowing.boundary.find_turn(knowing.y) == 0.0
    pulls = knowing.boundary.pull(1.0)
    assert pulls is not None
    assert np.diag(pulls.R).tolist() == [1.0, 1.0, 1.0, 0.0]
    assert knowing.boundary.pull(4.0).R[0, 0] == 2.0


def test_angles_of_phases_pull_as_far_as_they_differ_from_a_turn_of_all():
    """The side that knows the angle is pulled to the differences of the other's angles, and never turned by them."""
    boundary = boundary_at(["6.abc"], "child")
    message = AdmmMessage(
        HEADER,
        6,
        1,
        tuple(np.linspace(0.1, 1.2, 12)),
        (0.0,) * 12,
        tuple(np.arange(1.0, 13.0)),
        unsettled=True,
        referenced=False,
        variables=boundary.names,
    )
    sides = {known: BoundaryIteration(Neighbour("child", 6, is_parent=False), boundary) for known in (True, False)}
    for known, side in sides.items():
        side.angle_known, side.received = known, message if known else replace(message, referenced=True)
        side.step(np.zeros(12))
    pulled, turn = sides[True].pull(1.0), sides[True].is_angle * 1.0
    assert pulled is not None
    assert pulled.R @ turn == pytest.approx(np.zeros(12), abs=1e-12)
    assert pulled.z @ pulled.R @ turn == pytest.approx(0.0, abs=1e-12)
    assert abs(pulled.R @ np.eye(12)[7]).max() > 1.0  # the angle of phase a alone
    follower = sides[False]
    assert follower.z is not None
    y = follower.z + 0.3 * follower.is_angle
    assert follower.find_turn(y) == pytest.approx(-0.3)
