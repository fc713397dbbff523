"""Many runs: strategies side by side, and sweeps of one key of a scenario."""
