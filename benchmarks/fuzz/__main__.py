"""The command line: ``python -m benchmarks.fuzz --help``."""

from benchmarks.fuzz.command import main

main(prog_name="python -m benchmarks.fuzz")
