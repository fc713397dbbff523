"""``python -m benchmarks.fuzz``: hostile inputs for every decoder."""
