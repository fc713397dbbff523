"""The command line: ``python -m benchmarks.crowd --help``."""

from benchmarks.crowd.command import main

main(prog_name="python -m benchmarks.crowd")
