"""``python -m benchmarks.latency``: from a scan's publication to the agreement of all areas."""
