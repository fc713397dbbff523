"""Boundary-exchange strategies: what an area makes of what it knows, and what it tells its neighbours."""

from collections.abc import Mapping

from agents.area_files.area_file import AreaFile
from agents.strategies.admm import Admm
from agents.strategies.angle_offset import AngleOffset
from agents.strategies.interface import Strategy

ASYNCHRONOUS: Mapping[str, type[Strategy]] = {
    "angle-offset": AngleOffset,
    "admm": Admm,
}


def make_strategy(content: AreaFile) -> Strategy:
    """The strategy that the area file names."""
    return ASYNCHRONOUS[content.strategy](content)
