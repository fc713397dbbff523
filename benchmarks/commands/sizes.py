"""How the feeders that commands are measured on are divided."""

BUSES_OF_AN_AREA = 500
SEED = 7


def count_areas(n_bus: int) -> int:
    return max(2, n_bus // BUSES_OF_AN_AREA)
