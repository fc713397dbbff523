"""The command line: ``python -m benchmarks.fault_histories --help``."""

from benchmarks.fault_histories.command import main

main(prog_name="python -m benchmarks.fault_histories")
