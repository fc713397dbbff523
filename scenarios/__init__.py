"""The side that knows the whole grid: networks, scenario files, telemetry made from the truth, faults as numbers."""
