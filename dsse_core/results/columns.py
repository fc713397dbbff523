"""Columns of the tables of results: one class a table, from which CSV, Parquet, Python and the reference page come.

Units are in the names. The string below a field explains it and those above it without one; ``docs/key_tables.py``
writes these into ``docs/reference/run-folder.md``. A column of an instance has one value for each row: unknown numbers
are nan, unknown times NaT, unknown texts ""; a table of a balanced network lacks the columns that are None.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

Numbers: TypeAlias = np.ndarray
Integers: TypeAlias = np.ndarray
Truths: TypeAlias = np.ndarray
Times: TypeAlias = np.ndarray
Texts: TypeAlias = Sequence[str]

OF_ALL_PHASES = ("unbalance_percent", "neutral_a")  # of a bus, of a branch: the same in the row of each phase


def find_first_rows(ids: Sequence[object] | np.ndarray) -> np.ndarray:
    """True in the first row of each bus or branch, whose rows follow each other, (n_row,)."""
    is_first = np.ones(len(ids), dtype=bool)
    is_first[1:] = [one != other for one, other in zip(ids[1:], ids[:-1], strict=True)]
    return is_first


def list_columns(columns: Any) -> dict[str, Any]:
    """The columns of an instance that its table has."""
    return {name: column for name, column in vars(columns).items() if column is not None}


@dataclass(frozen=True, kw_only=True)
class BusColumns:
    """One row for each bus, or for each of its phases."""

    bus: Integers
    area: Texts
    """number and owner"""
    true_vm_pu: Numbers
    true_va_deg: Numbers
    """truth, where it is known"""
    centralised_vm_pu: Numbers
    centralised_va_deg: Numbers
    """centralised estimate"""
    decentralised_vm_pu: Numbers
    decentralised_va_deg: Numbers
    """estimate of the owner"""
    sigma_vm_pu: Numbers
    sigma_va_deg: Numbers
    """standard deviations; of areas the owner's own, under `angle-offset` that of the angle relative to its local
    slack"""
    name: Texts
    phase: Texts
    """name in the network file, phase"""
    vm_pu: Numbers
    va_deg: Numbers
    vm_kv: Numbers
    """the estimated voltage, of areas that of the owner; of a power flow the true one"""
    p_kw: Numbers
    q_kvar: Numbers
    """injection, generation minus load; the power of its shunt is a loss"""
    unbalance_percent: Numbers | None = None
    """negative by positive sequence of the bus; only with phases, as the next"""
    grounded: Truths | None = None
    """false without path to ground: only voltages between phases, and sums of powers, mean anything; standard
    deviations are empty
    """
    sigma_vm_kv: Numbers
    sigma_p_kw: Numbers
    sigma_q_kvar: Numbers
    """standard deviations of these"""
    scan: Texts
    time: Times
    """scan and its time, where known"""
    quality: Texts
    value_age_s: Numbers
    fresh: Truths
    """[of the numbers](../explanation/quality.md#quality-and-age-of-each-number), those of the owner; no age in one
    place"""


@dataclass(frozen=True, kw_only=True)
class BranchColumns:
    """One row for each branch, or for each of its phases."""

    branch: Texts
    name: Texts
    from_bus: Integers
    to_bus: Integers
    phase: Texts
    """id, name in the network file, ends, phase"""
    in_service: Truths
    """closed; an open branch carries 0"""
    p_from_kw: Numbers
    q_from_kvar: Numbers
    i_from_a: Numbers
    """power and current into the branch at its from end"""
    p_to_kw: Numbers
    q_to_kvar: Numbers
    i_to_a: Numbers
    """the same at its to end, in A of that side"""
    loss_kw: Numbers
    loss_kvar: Numbers
    """sum of both ends, charging included; of coupled phases only the total is a loss"""
    loading_percent: Numbers
    """larger current of the two ends by `rating_a`, or apparent power by `rating_mva`; empty without a rating"""
    neutral_a: Numbers | None = None
    """current that returns at the from end: sum of all phases; only with phases"""
    tap_ratio: Numbers | None = None
    sigma_tap_ratio: Numbers | None = None
    tap_steps_off: Numbers | None = None
    """the estimated tap, its standard deviation, and the nearest number of steps from `tap_ratio` of the network file;
    only with `estimate_tap`"""
    sigma_p_from_kw: Numbers
    sigma_q_from_kvar: Numbers
    sigma_i_from_a: Numbers
    sigma_p_to_kw: Numbers
    sigma_q_to_kvar: Numbers
    sigma_i_to_a: Numbers
    sigma_loss_kw: Numbers
    sigma_loss_kvar: Numbers
    """standard deviations of the powers, currents and losses"""
    scan: Texts
    time: Times
    """scan and its time, where known"""
    quality: Texts
    value_age_s: Numbers
    fresh: Truths
    """as of buses, of the area that holds the branch"""


@dataclass(frozen=True)
class MeterColumns:
    """One row for each meter. Of each quantity only the column in the meter's unit has a value."""

    meter: Texts
    kind: Texts
    bus: Integers
    branch: Texts
    phase: Texts
    """id and place"""
    source: Texts
    """`telemetered`, `pseudo`, `virtual`"""
    status: Texts
    """`used`, `removed` as bad data, `critical` (its errors cannot be seen), `silent` (no reading), `silent: dead`
    (without supply)"""
    value_pu: Numbers
    value_deg: Numbers
    value_kw: Numbers
    value_kvar: Numbers
    value_a: Numbers
    """the reading"""
    sigma_pu: Numbers
    sigma_deg: Numbers
    sigma_kw: Numbers
    sigma_kvar: Numbers
    sigma_a: Numbers
    """its standard deviation; 0 where it holds exactly"""
    estimate_pu: Numbers
    estimate_deg: Numbers
    estimate_kw: Numbers
    estimate_kvar: Numbers
    estimate_a: Numbers
    """the reading without error in the estimated state"""
    residual_pu: Numbers
    residual_deg: Numbers
    residual_kw: Numbers
    residual_kvar: Numbers
    residual_a: Numbers
    """reading - estimate, of angles within half a turn"""
    normalised_residual: Numbers
    """magnitude of the residual by its standard deviation; of a removed meter that of its removal; empty without
    redundancy, or where the reading holds exactly"""
    scan: Texts
    time: Times
    """scan and its time, where known"""


@dataclass(frozen=True)
class AreaColumns:
    """One row for each area."""

    area: Texts
    phase: Texts
    owned_buses: Integers
    """name, phases, number of buses that it owns"""
    load_kw: Numbers
    load_kvar: Numbers
    generation_kw: Numbers
    generation_kvar: Numbers
    """sums over the buses that draw, and over those that inject, the substation among them, P and Q each by itself;
    only the balance of a bus is estimated"""
    loss_kw: Numbers
    loss_kvar: Numbers
    """of its branches and of the shunts of its buses"""
    import_kw: Numbers
    import_kvar: Numbers
    """over the boundaries: `generation + import = load + loss`"""
    gap_vm_pu: Numbers
    gap_va_deg: Numbers
    error_vm_pu: Numbers
    error_va_deg: Numbers
    exchanges: Numbers
    messages: Numbers
    bytes: Numbers
    lost: Numbers
    rejected: Numbers
    objective: Numbers
    degrees_of_freedom: Numbers
    removed: Numbers
    critical: Numbers
    """as in `result.json`, counts of the last two and of `rejected`; only of areas"""
    quality: Texts
    """[quality](../explanation/quality.md) of the areas' state; of many estimates in one place `good`, `degraded` where
    bad data are left, `none`"""
    sigma_load_kw: Numbers
    sigma_load_kvar: Numbers
    sigma_generation_kw: Numbers
    sigma_generation_kvar: Numbers
    sigma_loss_kw: Numbers
    sigma_loss_kvar: Numbers
    sigma_import_kw: Numbers
    sigma_import_kvar: Numbers
    """where those of all branches and buses of the area are known"""
    scan: Texts
    time: Times
    """scan and its time, where known"""
    value_age_s: Numbers
    fresh: Truths
    """as of buses"""


@dataclass(frozen=True, kw_only=True)
class ScanColumns:
    """One row for each of many scans."""

    scan: Texts
    time: Times
    """its name, and its time where the name states one"""
    status: Texts
    """`estimated`, `failed`"""
    readings: Integers
    objective: Numbers
    degrees_of_freedom: Integers
    chi_square_limit: Numbers
    iterations: Integers
    """number of readings; J, its expectation and its limit; steps"""
    removed: Integers
    removed_meters: Texts
    undecided_meters: Texts
    """number and ids of the meters removed as bad data, and ids of those that the readings do not tell from them"""
    switched: Texts
    """ids of switches that count the other way than given, as the readings contradict that"""
    bad_data_left: Truths
    """J still exceeds its limit"""
    lowest_vm_pu: Numbers
    lowest_vm_bus: Numbers
    lowest_vm_phase: Texts | None = None
    highest_vm_pu: Numbers
    highest_vm_bus: Numbers
    highest_vm_phase: Texts | None = None
    """extreme voltages, their buses, and phases where there are some"""
    failure: Texts
    reason: Texts
    """`invalid`, `unobservable` or `diverged`, and the reason in words, where there is no estimate"""
