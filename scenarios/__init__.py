"""The side that knows the whole grid: networks, scenarios, importers, telemetry made or read, faults as numbers.

Part of consensus-dsse.
"""
