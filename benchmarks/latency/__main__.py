"""The command line: ``python -m benchmarks.latency --help``."""

from benchmarks.latency.command import main

main(prog_name="python -m benchmarks.latency")
