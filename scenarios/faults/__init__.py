"""Faults of links, telemetry and processes as a scenario states them."""
