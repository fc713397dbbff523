"""What every result has: its tables by name."""

from __future__ import annotations

from dsse_core.results.results import Results
from dsse_core.results.table import Table


class WithTables:
    """A result with ``tables``, each of which is an attribute of its own."""

    @property
    def tables(self) -> Results:
        """All four."""
        raise NotImplementedError

    @property
    def buses(self) -> Table:
        """One row per bus, in the order of the network."""
        return self.tables.buses

    @property
    def branches(self) -> Table:
        """One row per branch, in the order of the network."""
        return self.tables.branches

    @property
    def meters(self) -> Table:
        """One row per meter, in the order of the scenario."""
        return self.tables.meters

    @property
    def areas(self) -> Table:
        """One row per area, in the order of the scenario."""
        return self.tables.areas
