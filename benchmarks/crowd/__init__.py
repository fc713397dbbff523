"""Very many strangers on the bus of a running feeder, and what they cost whoever looks on."""
