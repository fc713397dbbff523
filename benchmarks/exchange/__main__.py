"""The command line: ``python -m benchmarks.exchange --help``."""

from benchmarks.exchange.command import main

main(prog_name="python -m benchmarks.exchange")
