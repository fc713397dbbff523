"""Very many strangers on the bus of a running feeder, and their cost for the watchers."""
