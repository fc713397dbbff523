"""Very many strangers on the bus of a running feeder, and what they cost the watchers."""
