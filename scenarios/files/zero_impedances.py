"""Problems of branches without impedance beside the others of a whole network, and their cure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Network
from dsse_core.grid.physical_ranges import find_range_problems


def find_zero_impedance_problems(
    network: Network, names: Mapping[str, str] | None = None, cure: str = "merge its two buses into one"
) -> Iterator[str]:
    """A problem for each branch of a whole ``network`` with too little impedance beside the others.

    ``names``: branch id -> its name in the source of the network; ``cure``: what to do there.
    """
    for branch in network.find_zero_impedances():
        name, share = (names or {}).get(branch.id), network.zero_share(branch)
        yield (
            f"branch {branch.id}{f' ({name})' if name else ''} has |r + jx| = {abs(complex(branch.r, branch.x)):.3g} "
            f"p.u., the median branch {network.median_impedance:.3g} p.u.; with less than {share:g} of the "
            f"median no estimate is exact: {cure}"
        )


def reject_zero_impedances(network: Network, names: Mapping[str, str], cure: str) -> None:
    """Rejects a ``network`` from another project's file for its branches without impedance.

    See ``find_zero_impedance_problems``.

    Raises:
        InvalidInputError: a problem for each such branch; or, since the median counts, for each number that no grid
            has.
    """
    if problems := list(find_range_problems(network)) or list(find_zero_impedance_problems(network, names, cure)):
        raise InvalidInputError(f"network {network.name!r}", problems)
