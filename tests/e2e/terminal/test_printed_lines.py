"""Lines that a command prints for the next step work when they are copied."""

from __future__ import annotations

import re
import shlex
import shutil
import ssl
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from tests.support.dsse_command import ENVIRONMENT
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import DEADLINE_S, wait_until

Dsse = Callable[..., subprocess.CompletedProcess[str]]
LIMIT = ("--timeout", str(DEADLINE_S), "--no-plots", "--quiet")


def next_words(done: subprocess.CompletedProcess[str]) -> list[str]:
    """The command of the last line, without the name of the program."""
    assert done.returncode == 0, done.stderr
    label, program, *words = shlex.split(done.stdout.splitlines()[-1])
    assert (label, program) == ("next:", "dsse")
    return words


def test_keys_run_the_scenario_that_they_were_made_for(dsse: Dsse) -> None:
    words = next_words(dsse("keys", "create", "industrial13", "--out", "my keys"))
    done = dsse(*words, *LIMIT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("consensus after")


def test_a_copied_and_a_generated_scenario_run(dsse: Dsse) -> None:
    for command in (("scenarios", "copy", "industrial13", "my feeder"), ("generate", "--buses", "12", "--out", "new")):
        done = dsse("simulate", *next_words(dsse(*command))[1:], *LIMIT)
        assert done.returncode == 0, done.stderr


def test_a_run_names_the_report_to_open(dsse: Dsse) -> None:
    done = dsse("simulate", "industrial13", "--out", "my run", "--quiet")
    assert done.returncode == 0, done.stderr
    word, address = done.stdout.splitlines()[-1].split()
    assert word == "open"
    with urllib.request.urlopen(address) as report:
        assert b"<title>" in report.read()


def test_the_page_is_opened_at_the_address_with_the_token_that_serve_prints(dsse: Dsse, tmp_path: Path) -> None:
    assert dsse("keys", "create", "industrial13").returncode == 0
    certificate = ("--tls-cert", "keys/router/router.crt", "--tls-key", "keys/router/router.key")
    with SystemByHand(tmp_path) as system:
        system.start("serve", "serve", "industrial13", "--simulate", "--listen", "127.0.0.1:0", *certificate)
        here = ("--listen", "127.0.0.1:0", "--token-file", "token", "--name", "feeder.example")
        system.start("kept", "serve", "industrial13", "--simulate", *here)
        wait_until(lambda: all("open http" in system.read_log(name) for name in ("serve", "kept")))
        plain, kept = (re.findall(r"^open (\S+)$", system.read_log(name), re.M)[-1] for name in ("serve", "kept"))
        trusted = ssl.create_default_context(cafile=str(tmp_path / "keys" / "router" / "authority.crt"))
        with httpx.Client(verify=trusted, timeout=DEADLINE_S) as browser:
            assert browser.get(plain).status_code == 200
            assert browser.get(kept.partition("?")[0]).status_code == 401
            assert browser.get(kept).status_code == 303
            of_proxy = {"host": "feeder.example", "origin": "https://feeder.example"}
            assert browser.get(kept, headers=of_proxy).status_code == 303
            assert browser.get(kept, headers={"host": "evil.example"}).status_code == 421
    token = (tmp_path / "token").read_text().strip()
    assert kept.endswith(f"/?token={token}")
    assert f"through a proxy: https://feeder.example/?token={token}\n" in system.read_log("kept")


@pytest.mark.skipif(not Path(sys.prefix, "bin", "dsse").exists(), reason="dsse is not installed")
def test_a_program_that_path_does_not_find_is_named_as_it_was_typed(tmp_path: Path) -> None:
    (tmp_path / "tools").symlink_to(Path(sys.prefix, "bin"))
    for path, typed in ((str(Path(sys.prefix, "bin")), "dsse"), ("/usr/bin:/bin", "tools/dsse")):
        environment = ENVIRONMENT | {"PATH": path}
        program = shutil.which("dsse", path=path) or typed
        done = subprocess.run(
            [program, "scenarios", "copy", "industrial13", f"for {typed.partition('/')[0]}"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=True,
        )
        assert shlex.split(done.stdout)[1] == typed
