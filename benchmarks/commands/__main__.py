"""``python -m benchmarks.commands``."""

from benchmarks.commands.command import main

if __name__ == "__main__":
    main(prog_name="python -m benchmarks.commands")
