"""The area file: all that one agent reads, per unit and radians. ``dsse split`` and ``dsse run`` write it.

A split writes its identity into each of its files (``agents/protocol/configuration_digest.py``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import tomli_w
from pydantic_core import to_json

from agents.protocol.configuration import Configuration, SplitStamp, rows_of, table_of
from agents.protocol.configuration_digest import digest_configuration, digest_split
from dsse_core.files.drafts import whole_file

FORMAT = 1


def save_area_file(path: Path, content: Configuration) -> None:
    """Write ``content`` to ``path`` as TOML, or as JSON where the name ends so; JSON is written and read much faster.

    TOML has a table for each bus, branch, generator and meter; JSON has the same keys, each with a list of all values.
    """
    is_json = path.suffix == ".json"
    table = {"format": FORMAT, **(table_of(content) if is_json else table_of(content, rows_of))}
    comment = f"# Area {content.area.name}: all that its agent reads. Per unit on base_mva, and radians.\n"
    with whole_file(path) as draft:
        draft.write_bytes(to_json(table) if is_json else (comment + tomli_w.dumps(table)).encode())


def stamp_split(
    files: Sequence[Configuration], time: float, sigmas: Mapping[str, Any] | None = None
) -> list[Configuration]:
    """``files``, all of one split, with its identity.

    ``time``: of the split, s since 1970 UTC. ``sigmas``: the rule of the meters' standard deviations.
    """
    contents = {content.area.name: digest_configuration(table_of(content)) for content in files}
    digest = digest_split(contents, sigmas or {})
    return [replace(content, split=SplitStamp(digest, contents[content.area.name], time)) for content in files]
