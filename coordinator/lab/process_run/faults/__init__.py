"""Faults that a scenario injects into the processes of a run: their schedule, their clock, their signals."""
