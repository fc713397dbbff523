"""A meter in the field."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class FieldMeter:
    """Reads ``value`` with normally distributed errors, every ``period_s``, all in the unit of its address.

    ``by``: ``mqtt``, ``opcua`` or ``modbus``; ``due``: when it reads next, monotonic time.
    """

    id: str
    by: str
    address: str
    value: float
    sigma: float
    period_s: float
    due: float = 0.0
