"""The command line inside this process."""

from __future__ import annotations

import pytest

from coordinator.cli.main import run_command


@pytest.fixture
def dsse(capsys: pytest.CaptureFixture[str]):
    """Run ``dsse``; exit code, standard output, standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = run_command([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    return run
