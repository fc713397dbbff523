"""Primitive admittances of lines and banks beside matrices derived by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dsse_core.grid.primitives import Connection, Side, build_bank, build_centre_tapped, build_line, connect

ONE, DELTA = np.eye(3), np.array([[2, -1, -1], [-1, 2, -1], [-1, -1, 2]])
TO_NEXT = np.array([[1, -1, 0], [0, 1, -1], [-1, 0, 1]])  # across the windings of a delta
BY_HAND: dict[tuple[Connection, Connection], tuple[np.ndarray, np.ndarray, np.ndarray]] = {
    ("grounded", "grounded"): (ONE, -ONE, ONE),
    ("wye", "grounded"): (DELTA / 3, -DELTA / 3, DELTA / 3),
    ("wye", "wye"): (DELTA / 3, -DELTA / 3, DELTA / 3),
    ("grounded", "delta"): (ONE, -TO_NEXT / np.sqrt(3), DELTA / 3),
    ("delta", "grounded"): (DELTA / 3, -TO_NEXT.T / np.sqrt(3), ONE),
    ("delta", "delta"): (DELTA / 3, -DELTA / 3, DELTA / 3),
    ("wye", "delta"): (DELTA / 3, -TO_NEXT / np.sqrt(3), DELTA / 3),
}


@pytest.mark.parametrize(("connections", "blocks"), BY_HAND.items())
def test_a_bank_has_the_blocks_of_its_connections_and_rows_that_add_up_to_zero_but_at_grounded_sides(
    connections: tuple[Connection, Connection], blocks: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """Blocks 1, [2, -1, -1] / 3 and [1, -1, 0] / 3^0.5; no side but a grounded one carries a zero sequence."""
    y, (at_from, between, at_to) = 1 - 5j, blocks
    Y = build_bank(connect("abc", connections[0]), connect("abc", connections[1]), y).y
    assert pytest.approx(y * np.block([[at_from, between], [between.T, at_to]]), abs=1e-14) == Y
    for side, connection in enumerate(connections):
        currents = Y[:, 3 * side : 3 * side + 3].sum(axis=1)[3 * side : 3 * side + 3]
        alone = connection == "grounded" and "wye" not in connections
        assert currents == pytest.approx(np.full(3, y if alone else 0), abs=1e-14)


def test_a_tap_multiplies_the_voltage_of_its_own_phase() -> None:
    bank = build_bank(connect("abc", "grounded"), connect("abc", "grounded", (1.05, 1.0, 0.95)), 1 - 5j)
    assert bank.y @ [1, 2, 3, 1.05, 2, 2.85] == pytest.approx(np.zeros(6), abs=1e-14)


def test_two_units_in_open_wye_and_open_delta_feed_three_phases() -> None:
    at_from, at_to = Side("ab", ("a", "b"), (1.0, 1.0)), Side("abc", ("ab", "bc"), (np.sqrt(3),) * 2)
    Y = build_bank(at_from, at_to, 1 - 5j).y
    assert Y[2:].sum(axis=0) == pytest.approx(np.zeros(5), abs=1e-14)
    va, vb, vc = 0.3 + 0j, 0.3 - np.sqrt(3), 0.3 - np.sqrt(3) * (1 + np.exp(-2j * np.pi / 3))
    assert Y @ [1, np.exp(-2j * np.pi / 3), va, vb, vc] == pytest.approx(np.zeros(5), abs=1e-13)


def test_a_centre_tapped_unit_is_that_of_opendss() -> None:
    """OpenDSS (opendssdirect.py 0.9.4): 25 kVA, %rs 0.6, 1.2, 1.2, xhl and xht 2.04, xlt 1.36."""
    at_to = Side("s1s2", ("s1",), (1.0,))
    unit = build_centre_tapped(Side("b", ("b",), (1.0,)), at_to, (0.012 + 0.017j) / 0.25)  # on a base of 100 kVA
    first = [6.92840647 - 9.81524249j, -3.46420323 + 4.90762125j, 3.46420323 - 4.90762125j]
    second = [first[1], 9.61687874 - 6.92185099j, 6.15267551 - 2.01422975j]
    assert unit.y == pytest.approx(np.array([first, second, [first[2], second[2], second[1]]]), abs=1e-8)


def test_a_line_has_its_series_admittance_between_its_ends_and_half_its_charging_at_each() -> None:
    z, charging = np.array([[0.03 + 0.1j, 0.01 + 0.05j], [0.01 + 0.05j, 0.04 + 0.11j]]), 2e-3j * (np.eye(2) - 0.1)
    line, v = build_line("bc", z, charging), np.array([1.0, 0.2j, 0.9, 0.1 + 0.3j])
    i = line.y @ v - np.r_[charging @ v[:2], charging @ v[2:]] / 2
    assert z @ i[:2] == pytest.approx(v[:2] - v[2:], abs=1e-14)
    assert i[2:] == pytest.approx(-i[:2], abs=1e-14)
    assert line.y @ np.ones(4) == pytest.approx(line.charging @ np.ones(4), abs=1e-13)
