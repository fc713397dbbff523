"""``python -m benchmarks.convergence``: convergence of power flow and estimate on public cases."""
