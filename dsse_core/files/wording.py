"""Words of error messages: the known name that a misspelt one may stand for."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from difflib import get_close_matches

MOST_COMPARISONS = 100_000
LONGEST_WORD = 200


@dataclass
class Suggestions:
    """Suggestions of the allowed words that are close to wrong ones, within a bound of work for long lists of them.

    ``left``: number of comparisons still to spend, each some ten microseconds.
    """

    allowed: Collection[str]
    left: int = MOST_COMPARISONS

    def find(self, word: str) -> str:
        """``"; did you mean 'x'?"`` where an allowed word is close to ``word``, else nothing."""
        close = self.find_word(word)
        return f"; did you mean {str(close)!r}?" if close else ""

    def find_word(self, word: str) -> str:
        """The allowed word that is close to ``word``, else nothing."""
        self.left -= len(self.allowed)
        if self.left < 0 or len(word) > LONGEST_WORD:
            return ""
        by_small_letters = {allowed.lower(): allowed for allowed in self.allowed}
        close = get_close_matches(word.lower(), by_small_letters, n=1)
        return by_small_letters[close[0]] if close else ""


def suggest(word: str, allowed: Iterable[str]) -> str:
    """The suggestion of ``Suggestions`` for a single word."""
    return Suggestions(list(allowed)).find(word)


def describe_unknown(what: str, name: str, known: Collection[str]) -> str:
    """The error text for ``name``, which is no ``what``: the names ``known``, and the known name close to it."""
    return f"unknown {what} {name!r}; allowed: {', '.join(known)}{suggest(name, known)}"
