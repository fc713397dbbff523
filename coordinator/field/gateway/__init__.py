"""The gateway: readings of meters from the field onto the bus, and results back, by sources and sinks of any kind."""

from coordinator.field.gateway.interface import Emit, MapPath, Result, Sink, Source
from dsse_core.files.strict_table import Table

__all__ = ["Emit", "MapPath", "Result", "Sink", "Source", "Table"]
