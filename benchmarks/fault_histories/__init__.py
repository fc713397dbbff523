"""``python -m benchmarks.fault_histories``: seeded histories of faults on the simulator."""
