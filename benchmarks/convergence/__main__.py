"""The command line: ``python -m benchmarks.convergence --help``."""

from benchmarks.convergence.command import main

main(prog_name="python -m benchmarks.convergence")
