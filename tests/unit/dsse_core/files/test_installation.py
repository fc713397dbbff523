"""The command that adds an optional package installs from where this project was installed."""

from __future__ import annotations

import json
import shlex
import sys
from importlib.metadata import PackageNotFoundError
from typing import Any

import pytest

from dsse_core.files import installation
from dsse_core.files.installation import ROOT, install_command


class Installed:
    def __init__(self, origin: dict[str, Any] | None) -> None:
        self._origin = origin

    def read_text(self, _: str) -> str | None:
        return self._origin and json.dumps(self._origin)


@pytest.mark.parametrize(
    ("origin", "words"),
    [
        ({"url": "file:///home/me/my%20work", "dir_info": {"editable": True}}, ["--editable", "/home/me/my work[web]"]),
        ({"url": "file:///home/me/work", "dir_info": {}}, ["/home/me/work[web]"]),
        ({"url": "file:///tmp/dsse.whl", "archive_info": {}}, ["/tmp/dsse.whl[web]"]),
        (
            {"url": "https://example.org/dsse.git", "vcs_info": {"vcs": "git"}},
            ["consensus-dsse[web] @ git+https://example.org/dsse.git"],
        ),
        (None, ["consensus-dsse[web]"]),
    ],
    ids=["editable", "folder", "wheel", "repository", "index"],
)
def test_an_extra_comes_from_where_the_project_came(
    monkeypatch: pytest.MonkeyPatch, origin: dict[str, Any] | None, words: list[str]
) -> None:
    monkeypatch.setattr(installation, "distribution", lambda _: Installed(origin))
    assert shlex.split(install_command("web")) == [sys.executable, "-m", "pip", "install", *words]


def test_a_checkout_that_is_not_installed_is_named_by_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(installation, "distribution", missing)
    assert shlex.split(install_command("web"))[-1] == f"{ROOT}[web]"
    assert (ROOT / "pyproject.toml").exists()
