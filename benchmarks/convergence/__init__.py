"""``python -m benchmarks.convergence``: on how many public cases power flow and estimate converge."""
