"""``dsse``: the command line, after a check that the packages that it imports are ours."""

from __future__ import annotations

import sys


def main() -> int:
    """Run ``dsse`` with the arguments of the process and return its exit code."""
    from consensus_dsse.own_packages import ForeignPackageError, check_own_packages

    try:
        check_own_packages()
    except ForeignPackageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    from coordinator.__main__ import main as command

    return command()


if __name__ == "__main__":
    sys.exit(main())
