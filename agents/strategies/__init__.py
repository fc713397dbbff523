"""Strategies: estimates of an area from its knowledge, and messages to its neighbours. With all names for your own."""

from agents.messages.checks import Count, Integer, Name, Names, Number, Numbers
from agents.messages.types import BoundaryUpdate, Header
from agents.protocol.configuration import Configuration
from agents.strategies.interface import Estimate, Knowledge, Strategy
from dsse_core.grid.partition import Neighbour

__all__ = [
    "BoundaryUpdate",
    "Configuration",
    "Count",
    "Estimate",
    "Header",
    "Integer",
    "Knowledge",
    "Name",
    "Names",
    "Neighbour",
    "Number",
    "Numbers",
    "Strategy",
]
