"""The area file: all that one agent reads, per unit and radians. ``dsse split`` and ``dsse run`` write it."""

from __future__ import annotations

from pathlib import Path

import tomli_w
from pydantic_core import to_json

from agents.protocol.configuration import Configuration, rows_of, table_of
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
