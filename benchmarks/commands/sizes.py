"""Division into areas of the feeders on which commands are measured."""

BUSES_OF_AN_AREA = 500
SEED = 7


def count_areas(n_bus: int) -> int:
    return max(2, n_bus // BUSES_OF_AN_AREA)
