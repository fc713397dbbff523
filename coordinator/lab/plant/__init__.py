"""The plant: makes the readings of all meters and publishes them, area by area."""
