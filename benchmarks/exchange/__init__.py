"""``python -m benchmarks.exchange``: messages and times of a scan on the simulator."""
