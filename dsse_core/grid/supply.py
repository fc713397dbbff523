"""Supply of the nodes of an area: which of them a path of closed branches joins to the substation, over any areas.

Per boundary an area says which of its nodes hang together on its side, and which of them are fed there: an elimination
like that of the information, once up and once down the tree of messages. A node that is not fed is dead.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dsse_core.grid.network import Network
from dsse_core.grid.partition import Area

FED = 0
Pieces = tuple[int, ...]
"""Of each node of a boundary: FED, or the number of its piece, the same where nodes hang together on that side."""


def find_pieces(area: Area, received: Mapping[str, Pieces], but: str = "", *, without: str = "") -> np.ndarray:
    """The number of the piece of each node of ``area``, (n_nodes,), FED where it is fed.

    ``received``: neighbour -> its pieces; a neighbour that has sent none, or a wrong number of them, counts as feeding.
    ``but``: a neighbour whose side does not count; ``without``: a branch that does not.
    """
    table = area.network.table
    island = (table.find_islands(list(area.network.branch_ids).index(without)) if without else table.node_island) + 1
    root = list(range(int(island.max(initial=0)) + 1))

    def find(piece: int) -> int:
        while root[piece] != piece:
            piece = root[piece]
        return piece

    def join(one: int, other: int) -> None:
        least, most = sorted((find(one), find(other)))
        root[most] = least  # FED is the least

    if area.reference:
        for node in area.network.nodes_at(area.reference[0]).tolist():
            join(FED, int(island[node]))
    for name, nodes in area.boundary_nodes.items():
        if name == but:
            continue
        pieces = received.get(name, ())
        pieces = pieces if len(pieces) == len(nodes) else (FED,) * len(nodes)
        first: dict[int, int] = {FED: FED}
        for node, piece in zip(nodes.tolist(), pieces, strict=True):
            join(first.setdefault(piece, int(island[node])), int(island[node]))
    found: np.ndarray = np.array([find(piece) for piece in range(len(root))], dtype=np.int64)[island]
    return found


def find_pieces_for(area: Area, neighbour: str, received: Mapping[str, Pieces]) -> Pieces:
    """The pieces at the boundary to ``neighbour`` on this side of it."""
    found = find_pieces(area, received, neighbour)[area.boundary_nodes[neighbour]].tolist()
    number = {FED: FED}
    return tuple(number.setdefault(piece, len(number)) for piece in found)


def find_alternatives(area: Area, received: Mapping[str, Pieces]) -> dict[str, Network]:
    """Switch of ``area`` -> its network with the other status of this switch, where that darkens and feeds no node, and
    the switch joins nodes that are fed. Of other switches no rows tell: those of a node that is not fed say nothing.
    """
    fed, found = find_pieces(area, received) == FED, {}
    for switch, is_closed in area.network.switches.items():
        if not fed[area.network.nodes_of(switch)].all():
            continue
        if not is_closed or ((find_pieces(area, received, without=switch) == FED) == fed).all():
            found[switch] = area.operated({switch: not is_closed}).network.with_dead(~fed)
    return found
