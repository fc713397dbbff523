"""The identity that a split writes into its files (``agents/protocol/configuration_digest.py``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from agents.protocol.configuration import Configuration, SplitStamp, table_of
from agents.protocol.configuration_digest import digest_configuration, digest_split


def stamp_split(
    files: Sequence[Configuration], time: float, sigmas: Mapping[str, Any] | None = None
) -> list[Configuration]:
    """``files``, all of one split, with its identity.

    ``time``: of the split, s since 1970 UTC. ``sigmas``: the rule of the meters' standard deviations.
    """
    contents = {content.area.name: digest_configuration(table_of(content)) for content in files}
    digest = digest_split(contents, sigmas or {})
    return [replace(content, split=SplitStamp(digest, contents[content.area.name], time)) for content in files]
