"""Foreign text made printable: names, notes and paths from other people, before they are shown anywhere."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import islice

LONGEST_LIST = 12
NOT_SEEN = frozenset(  # letters and marks that are shown as nothing or as a blank, though Unicode calls them printable
    chr(number)
    for first, last in (
        (0x034F, 0x034F),  # combining grapheme joiner
        (0x115F, 0x1160),  # Hangul fillers
        (0x17B4, 0x17B5),  # Khmer inherent vowels
        (0x180B, 0x180F),  # Mongolian variation selectors
        (0x2800, 0x2800),  # Braille blank
        (0x3164, 0x3164),
        (0xFE00, 0xFE0F),  # variation selectors
        (0xFFA0, 0xFFA0),
        (0xE0100, 0xE01EF),
    )
    for number in range(first, last + 1)
)


def printable(text: object) -> str:
    r"""``text`` on one line, with an escape such as ``\x1b`` for every character that is not seen as itself.

    Such characters steer a terminal (escape, carriage return, C1 controls), turn the order of letters or hide them, are
    letters that are not seen, line ends, blanks other than the plain one, or bytes of a file name that are no text.
    """
    shown = str(text)
    if _is_printable(shown):
        return shown
    return "".join(
        c if c.isprintable() and c not in NOT_SEEN else c.encode("unicode_escape").decode("ascii") for c in shown
    )


def all_printable(texts: Sequence[str]) -> list[str]:
    """``printable`` of each of ``texts``; all are tested together first, as hardly any text has an escape."""
    return list(texts) if _is_printable("".join(texts)) else list(map(printable, texts))


def printable_lines(text: str) -> str:
    """``text`` with the same escapes, its lines kept."""
    return text if _is_printable(text.replace("\n", "")) else "\n".join(map(printable, text.split("\n")))


def _is_printable(text: str) -> bool:
    return text.isprintable() and (text.isascii() or NOT_SEEN.isdisjoint(text))


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
    """``1, 2, 3``: at most ``most`` of ``items`` in one text, and the number of the remaining items."""
    shown = [str(item) for item in islice(items, most)]
    more = len(items) - len(shown)
    return separator.join(shown) + (f" and {more} more" if more else "")
