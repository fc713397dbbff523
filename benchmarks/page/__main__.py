"""``python -m benchmarks.page``."""

from benchmarks.page.command import main

if __name__ == "__main__":
    main(prog_name="python -m benchmarks.page")
