"""Words of error messages: what a misspelt name may have been."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from difflib import get_close_matches

MOST_COMPARISONS = 100_000
LONGEST_WORD = 200


@dataclass
class Suggestions:
    """Words close to others, until so many were compared that a list of wrong words would take long.

    ``left``: how many more comparisons there may be, each some ten microseconds.
    """

    allowed: Collection[str]
    left: int = MOST_COMPARISONS

    def find(self, word: str) -> str:
        """``"; did you mean 'x'?"`` when one of those allowed is close to ``word``, else nothing."""
        self.left -= len(self.allowed)
        if self.left < 0 or len(word) > LONGEST_WORD:
            return ""
        by_small_letters = {allowed.lower(): allowed for allowed in self.allowed}
        close = get_close_matches(word.lower(), by_small_letters, n=1)
        return f"; did you mean {by_small_letters[close[0]]!r}?" if close else ""


def suggest(word: str, allowed: Iterable[str]) -> str:
    """What ``Suggestions`` finds for a single word."""
    return Suggestions(list(allowed)).find(word)


def describe_unknown(what: str, name: str, known: Collection[str]) -> str:
    """That ``name`` is no ``what``, which are ``known``, and which of them it may have been."""
    return f"unknown {what} {name!r}; allowed: {', '.join(known)}{suggest(name, known)}"
