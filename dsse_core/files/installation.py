"""The installation of consensus-dsse, and the command that adds optional packages to it."""

from __future__ import annotations

import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from dsse_core.files.bounded_parsing import parse_json

NAME = "consensus-dsse"
ROOT = Path(__file__).parents[2]  # of a checkout that runs without being installed


def install_command(extra: str = "", *options: str) -> str:
    """The command for a shell that installs this project again with ``extra``, from where this one came.

    A wheel or checkout is named by its path, a repository by its address. Without a record of the origin pip looks for
    the project in its index. ``options``: of pip.
    """
    what = f"[{extra}]" if extra else ""
    return shlex.join([sys.executable or "python3", "-m", "pip", "install", *options, *_find_origin(what)])


def _find_origin(extra: str) -> list[str]:
    try:
        found = distribution(NAME).read_text("direct_url.json")
    except PackageNotFoundError:
        return [f"{ROOT}{extra}"]
    if not found:
        return [NAME + extra]
    origin = parse_json(found)
    url = urlsplit(origin["url"])
    if url.scheme == "file":
        editable = ["--editable"] if origin.get("dir_info", {}).get("editable") else []
        return [*editable, url2pathname(url.path) + extra]
    kind = origin.get("vcs_info", {}).get("vcs")
    return [f"{NAME}{extra} @ {f'{kind}+' if kind else ''}{origin['url']}"]
