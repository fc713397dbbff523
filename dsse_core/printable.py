"""Foreign text made printable: names, notes and paths that others chose, before they are shown anywhere."""

from __future__ import annotations

from collections.abc import Collection
from itertools import islice

LONGEST_LIST = 12


def printable(text: object) -> str:
    r"""``text`` on one line, with an escape such as ``\x1b`` for every character that is not seen as itself.

    Those are what steers a terminal (escape, carriage return, C1 controls), what turns the order of letters or hides
    them, line ends, blanks other than the plain one, and bytes of a file name that are no text.
    """
    shown = str(text)
    if shown.isprintable():
        return shown
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in shown)


def printable_lines(text: str) -> str:
    """``text`` with the same escapes, its lines kept."""
    return "\n".join(map(printable, text.split("\n")))


def on_one_line(text: object) -> str:
    """``text``, such as another library's error, with each run of blanks and line ends as one blank."""
    return " ".join(str(text).split())


def shortened(text: str, longest: int) -> str:
    """``text``, or its beginning and three dots: ``longest`` characters at most."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def shortened_inside(text: str, longest: int) -> str:
    """``text``, or its beginning, three dots and its last quarter: ``longest`` characters at most."""
    end = longest // 4
    return text if len(text) <= longest else f"{text[: longest - end - 5]} ... {text[-end:]}"


def listed(items: Collection[object], most: int = LONGEST_LIST, separator: str = ", ") -> str:
    """``1, 2, 3``: at most ``most`` of ``items`` in one text, and how many more there are."""
    shown = [str(item) for item in islice(items, most)]
    more = len(items) - len(shown)
    return separator.join(shown) + (f" and {more} more" if more else "")
