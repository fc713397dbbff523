"""The text of an OpenDSS circuit, checked before OpenDSS sees any of it.

A ``.dss`` file is a program: its verbs write files anywhere, its properties read files and load native code. So each
statement is taken apart here and written again, with full names and plain values, from words of ``vocabulary.toml``
only: OpenDSS never parses what the author of the file has written. It opens no file either: redirects are followed
here, and numbers of load shapes and places of buses read here, within one folder.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_bounded
from dsse_core.printable import listed, printable, shortened
from scenarios.importers.imported import Remark
from scenarios.importers.opendss.vocabulary import Words, load_vocabulary

MOST_BYTES = 64 * 2**20  # of all files of a circuit, each as often as it is read
MOST_FILES = 2000
MOST_STATEMENTS = 300_000
MOST_LINES = 2_000_000  # of all files
MOST_PIECES = 2_000_000  # values and names, and numbers in files
MOST_PIECES_OF_LINE = 1000
LONGEST_ROW = 10_000  # characters of a line of numbers or of places
LONGEST_PATH = 1000
LONGEST_WORD = 100  # characters of a name or number
DEEPEST_REDIRECT = 20
MOST_PROBLEMS = 50
SERIES = ("line", "transformer", "reactor", "capacitor")  # classes whose elements may be open
SOURCE = "vsource.source"  # that every circuit begins with
LONGEST_SHOWN = 60  # characters of a statement
LINE_END = re.compile("\r\n|\r|\n")
CONTROL = re.compile("[\0-\x08\x0b\x0c\x0e-\x1f\x7f]")  # but tabs and line ends
PIECE = re.compile(
    r"""[ \t,]*+(?:(?P<name>[^\s,="'()\[\]{}!]++)[ \t]*+=[ \t]*+)?+"""
    r"""(?:(?P<quoted>"[^"]*+"|'[^']*+'|\([^)]*+\)|\[[^\]]*+\]|\{[^}]*+\})|(?P<plain>[^\s,="'()\[\]{}!]++))"""
)
END = re.compile(r"[ \t,]*+(?:(?:!|//).*)?+\Z")
PLAIN = re.compile(r"[\w.+-]+", re.ASCII)
VALUE = re.compile(r"[\w.+\-#/%&$:;~^*|,() \t]*", re.ASCII)  # no quotes, brackets, =, @ and backslashes
NAME = re.compile(r"[\w.+\-#/%&$:;~]+", re.ASCII)
PATTERN = re.compile(r"\^?[\w.\-#/%&:;~]*+\*?\$?", re.ASCII)  # of batchedit, a regular expression of one * at most
LONG_WORD = re.compile(r"(?<![^\s,|()])[^\s,|()]{" f"{LONGEST_WORD + 1}" "}")
BUS = re.compile(r"[\w+\-#/%&$:;~]+(?:\.\d{1,2})*\.?", re.ASCII)
BUSES = ("bus", "bus1", "bus2", "buses", "vbus")
MOST = {
    "phases": 6,
    "nphases": 6,
    "windings": 6,
    "wdg": 6,
    "nconds": 20,
    "cond": 20,
    "npts": 1_000_000,
    "numsteps": 100,
}
"""Property -> its largest value, where more could make OpenDSS fail or never end."""
COLUMN = re.compile(r"[1-9]\d{0,3}", re.ASCII)
OPTION = r"\w++\s*+=\s*+\w++"
QUOTED_NAME = re.compile(r"""(?P<quote>["'])([\w.+\-#/%&$:;~]*+)(?P=quote)""", re.ASCII)
LIST_IN_FILE = re.compile(
    rf"\s*+file\s*+=\s*+(?P<file>\"[^\"]*+\"|'[^']*+'|[^\s,=\"']++)(?P<rest>(?:[\s,]++{OPTION})*+)[\s,]*+",
    re.IGNORECASE | re.ASCII,
)
WRITES = "OpenDSS may write files, run programs or change with it what is imported; take the line out"


@dataclass(frozen=True)
class Command:
    """A statement for OpenDSS, and the place of its text."""

    text: str
    place: str


@dataclass
class Script:
    """A circuit: its ``commands``, the places of its buses, and remarks; ``name``: of the circuit."""

    name: str = ""
    commands: list[Command] = field(default_factory=list)
    places: dict[str, tuple[float, float]] = field(default_factory=dict)
    remarks: list[Remark] = field(default_factory=list)


class _RefusedError(Exception):
    """A problem of one statement."""


@dataclass(frozen=True)
class _Piece:
    """A value, with the name before its = sign, in lower case, or ""."""

    name: str
    text: str
    is_quoted: bool


def read_script(path: Path, within: Path | None = None) -> Script:
    """Check the circuit in ``path`` and the files that it names, all of them in the folder ``within``.

    ``within``: by default the folder of ``path``.

    Raises:
        InvalidInputError: listing, by file and line, every statement that is not known to be harmless.
    """
    first = path.resolve()
    reader = _Reader((within or first.parent).resolve())
    if not first.is_relative_to(reader.root):
        raise InvalidInputError(
            str(path), [f"lies outside the folder {reader.root} of --within; give a folder above it"]
        )
    reader.read_file(first, printable(path.name), 0)
    if not reader.problems and not reader.script.name:
        reader.problems.append("no circuit: a line such as 'new circuit.NAME basekv=12.47' is missing")
    if reader.problems:
        raise InvalidInputError(str(path), reader.problems)
    return reader.finish()


class _Reader:
    def __init__(self, root: Path) -> None:
        self.root, self.words = root, load_vocabulary()
        self.script, self.problems = Script(), list[str]()
        self.open: list[Path] = []
        self.bytes_left, self.files_left, self.statements_left = MOST_BYTES, MOST_FILES, MOST_STATEMENTS
        self.lines_left, self.pieces_left = MOST_LINES, MOST_PIECES
        self.active: str | None = None  # the object that ~ goes on with, class.name; "" where it is left out
        self.left_out = Counter[str]()
        self.place = ""

    def finish(self) -> Script:
        if self.left_out:
            text = (
                f"{listed([f'{name} ({count})' for name, count in self.left_out.items()], 40)}: no power flow needs it"
            )
            self.script.remarks.append(Remark("left out", text))
        return self.script

    def read_file(self, path: Path, called: str, depth: int) -> None:
        """Execute all statements of a file."""
        if path in self.open:
            raise _RefusedError(f"{called} is being read already: it redirects to itself, without end")
        text = self._read_text(path)
        self.open.append(path)
        in_comment = False
        for number, line in enumerate(LINE_END.split(text), 1):
            if len(self.problems) >= MOST_PROBLEMS:
                break
            stripped = line.strip(" \t")
            in_comment = in_comment or stripped.startswith("/*")
            if not in_comment and stripped:
                self.statements_left -= 1
                if self.statements_left < 0:
                    self.problems.append(f"{called} line {number}: more than {MOST_STATEMENTS:,} statements")
                    break
                self.place = f"{called} line {number}"
                try:
                    self._execute(stripped, path, depth)
                except _RefusedError as error:
                    shown = printable(shortened(stripped, LONGEST_SHOWN))
                    self._add_problem(f"{called} line {number}: {shown}: {error}")
            in_comment = in_comment and "*/" not in line
        self.open.pop()

    def _add_problem(self, problem: str) -> None:
        self.problems.append(problem)
        if len(self.problems) == MOST_PROBLEMS:
            self.problems.append("there may be more; the rest is not read")

    def _read_text(self, path: Path) -> str:
        try:
            content = read_bounded(path, self.bytes_left)
        except OSError as error:
            raise self._refuse_file(path, f"cannot be read: {error.strerror}") from None
        self.bytes_left -= len(content)
        self.files_left -= 1
        if self.files_left < 0:
            raise _RefusedError(f"more than {MOST_FILES} files are read; look for redirects that repeat each other")
        self.lines_left -= max(content.count(b"\n"), content.count(b"\r"))
        if self.lines_left < 0:
            raise self._refuse_file(path, f"more than {MOST_LINES:,} lines are read")
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")  # letters beyond ASCII are for comments only
        if found := CONTROL.search(text):
            line = len(LINE_END.findall(text, 0, found.start())) + 1
            raise self._refuse_file(path, f"line {line}: holds the character {found[0]!r}; this is no text")
        return text

    def _refuse_file(self, path: Path, problem: str) -> Exception:
        """The error of a file: where it is the first one, that of the whole import."""
        if self.open:
            return _RefusedError(f"{printable(path.name)} {problem}")
        return InvalidInputError(str(path), [problem])

    def _find_file(self, given: str, by: Path) -> Path:
        """The file that a file ``by`` names, relative to its own folder."""
        if len(given) > LONGEST_PATH:
            raise _RefusedError(f"a path has at most {LONGEST_PATH:,} characters")
        if not given or PureWindowsPath(given).is_absolute() or given.startswith(("/", "\\", "~")):
            raise _RefusedError(f"{printable(given)!r} is no path relative to the folder of the file that names it")
        path = by.parent
        for part in given.replace("\\", "/").split("/"):
            path = _match(path, part)
        path = path.resolve()
        if not path.is_relative_to(self.root):
            problem = f"{printable(given)} lies outside the folder {self.root}; copy it there, or allow a folder above"
            raise _RefusedError(f"{problem} with --within")
        return path

    def _execute(self, line: str, path: Path, depth: int) -> None:
        pieces = list(itertools.islice(_split(line), MOST_PIECES_OF_LINE + 1))
        if not pieces:
            return
        if len(pieces) > MOST_PIECES_OF_LINE:
            raise _RefusedError(f"a line has at most {MOST_PIECES_OF_LINE:,} values; a list stands in brackets")
        self._count_pieces(len(pieces))
        first, rest = pieces[0], pieces[1:]
        if first.name:
            self._assign(first, rest, path)
            return
        verb = self.words.verbs.find(first.text)
        if verb is None:
            raise _RefusedError(f"{first.text!r} is no verb of OpenDSS")
        mark = self.words.verbs.marks[verb]
        if mark == "refused":
            raise _RefusedError(f"the verb {verb} is refused: {WRITES}")
        if mark == "left out":
            self.left_out[verb] += 1
            return
        if verb not in ("redirect", "compile", "new", "edit", "more", "m", "~"):
            self.active = None  # as OpenDSS may go on with an element that it names
        if verb in ("redirect", "compile"):
            if depth >= DEEPEST_REDIRECT:
                raise _RefusedError(f"redirects are nested more than {DEEPEST_REDIRECT} deep")
            found = self._find_file(_take_path(rest), path)
            self.read_file(found, printable(found.relative_to(self.root)), depth + 1)
        elif verb in ("new", "edit", "more", "m", "~"):
            self._build(verb, rest, path)
        elif verb == "batchedit":
            self._edit_batch(rest, path)
        elif verb in ("clear", "clearall"):
            kept = [one for one in self.script.commands if one.text.startswith("set defaultbasefrequency=")]
            self.script, self.left_out = Script(commands=kept), Counter()
        elif verb in ("set", "solve"):
            self._set(rest)
            if verb == "solve":
                self._hand_over("solve")
        elif verb in ("buscoords", "setbusxy"):
            self._place_buses(verb, rest, path)
        elif verb in ("open", "close", "enable", "disable"):
            self._switch(verb, rest)
        elif verb == "setkvbase":
            if len(rest) != 2 or rest[1].name not in ("kvll", "kvln", ""):
                raise _RefusedError("give a bus, and kvll= or kvln=")
            self._hand_over(f"setkvbase {_write('bus', rest[0].text)} {_write(rest[1].name or 'kvll', rest[1].text)}")
        else:  # calcvoltagebases, makebuslist, reprocessbuses, buildy
            self._hand_over(verb)

    def _count_pieces(self, count: int) -> None:
        self.pieces_left -= count
        if self.pieces_left < 0:
            raise _RefusedError(f"more than {MOST_PIECES:,} values are read")

    def _hand_over(self, text: str) -> None:
        if len(self.script.commands) >= MOST_STATEMENTS:
            raise _RefusedError(f"more than {MOST_STATEMENTS:,} statements")
        self.script.commands.append(Command(text, self.place))

    def _assign(self, first: _Piece, rest: Sequence[_Piece], path: Path) -> None:
        """A statement without a verb: ``class.name.property=value``."""
        parts = first.name.split(".")
        if len(parts) < 3:
            raise _RefusedError(f"{first.name!r} is no class.name.property")
        head, tail = _Piece("", ".".join(parts[:-1]), False), _Piece(parts[-1], first.text, first.is_quoted)
        self._build("edit", [head, tail, *rest], path)

    def _build(self, verb: str, pieces: Sequence[_Piece], path: Path) -> None:
        """New, edit, and more of the object that is active."""
        if verb in ("new", "edit"):
            if not pieces or pieces[0].name not in ("", "object"):
                raise _RefusedError("give the class and the name of an object, class.name")
            kind, name = _split_object(pieces[0].text)
            self._name_object(verb, kind, name)
            pieces = pieces[1:]
        if self.active is None:
            raise _RefusedError("no object is there that it goes on with; write edit and the object's class.name")
        if not self.active:
            return
        kind, name = self.active.split(".", 1)
        text = self._read_properties(kind, pieces, path)
        if verb == "new" and self.active == SOURCE:
            self._hand_over(f"new circuit.{self.script.name} {text}")
        elif verb == "new" or text:
            self._hand_over(f"{'new' if verb == 'new' else 'edit'} {self.active} {text}")

    def _name_object(self, verb: str, kind: str, name: str) -> None:
        """Make an object the active one; it is left out where its class is."""
        if kind in self.words.left_out:
            self.left_out[kind] += verb == "new"
            self.active = ""
            return
        self.active = None
        if verb == "new" and kind == "circuit":
            if self.script.name:
                raise _RefusedError(f"a second circuit beside {self.script.name}; give the file of one circuit")
            self.script.name, self.active = name, SOURCE
            return
        if kind not in self.words.classes:
            classes = listed(list(self.words.classes), 40)
            raise _RefusedError(f"the class {printable(kind)!r} is not read; these are: {classes}")
        if not self.script.name:
            raise _RefusedError("no circuit is there yet; begin with 'new circuit.NAME'")
        self.active = f"{kind}.{name}"
        if verb == "new" and self.active == SOURCE:
            raise _RefusedError("the circuit has made this source; write edit in place of new")

    def _read_properties(self, kind: str, pieces: Sequence[_Piece], path: Path) -> str:
        """Properties of an object written again, with their full names."""
        words, place, found = self.words.classes[kind], -1, list[str]()
        for piece in pieces:
            word = words.find(piece.name) if piece.name else _at(words, place + 1)
            if word is None:
                what = f"{printable(piece.name)!r} is no property" if piece.name else f"{piece.text!r} has no name"
                raise _RefusedError(f"{what} of the class {kind}")
            place = words.order.index(word)
            if words.marks[word] == "refused":
                reason = "it may read files, load code, or change what is imported; take it out"
                raise _RefusedError(f"the property {word} of a {kind} is refused: {reason}")
            if words.marks[word] == "left out":
                continue
            if kind == "loadshape":
                found += self._read_shape(word, piece, path)
            else:
                found.append(_write(word, piece.text))
        return " ".join(found)

    def _read_shape(self, word: str, piece: _Piece, path: Path) -> Iterator[str]:
        """A property of a load shape, with the numbers of the file that it may name."""
        in_file = LIST_IN_FILE.fullmatch(piece.text)
        if word == "csvfile":
            rows = self._read_numbers(self._find_file(_unquote(piece.text), path))
            if rows and len(rows[0]) > 1:
                yield _write("hour", " ".join(row[0] for row in rows))
            yield _write("mult", " ".join(row[-1] for row in rows))
        elif in_file is not None and word in ("mult", "pmult", "qmult", "hour"):
            given = re.findall(OPTION, in_file["rest"].lower())
            options = {key.strip(): value.strip() for key, value in (text.split("=") for text in given)}
            if not set(options) <= {"col", "header"} or not COLUMN.fullmatch(options.get("col", "1")):
                raise _RefusedError("beside file= of a list of numbers col=, from 1 on, and header= are known")
            column = int(options.get("col", "1")) - 1
            has_header = options.get("header", "no")[0] in "yt"
            rows = self._read_numbers(self._find_file(_unquote(in_file["file"]), path))[int(has_header) :]
            if any(len(row) <= column for row in rows):
                raise _RefusedError(f"{in_file['file']} has lines with less than {column + 1} columns")
            yield _write(word, " ".join(row[column] for row in rows))
        elif word == "action" and not "normalize".startswith(piece.text.lower()):
            raise _RefusedError("the action of a loadshape is normalize; others write files")
        else:
            yield _write(word, piece.text)

    def _read_numbers(self, path: Path) -> list[list[str]]:
        lines = (line.strip() for line in LINE_END.split(self._read_text(path)))
        return [self._split_row(line, r"[\s,;]+", path) for line in lines if line]

    def _split_row(self, line: str, separator: str, path: Path) -> list[str]:
        if len(line) > LONGEST_ROW:
            raise _RefusedError(f"{printable(path.name)} has a line of more than {LONGEST_ROW:,} characters")
        row = re.split(separator, line)
        self._count_pieces(len(row))
        return row

    def _edit_batch(self, pieces: Sequence[_Piece], path: Path) -> None:
        if not pieces or pieces[0].name:
            raise _RefusedError("give a class and a pattern of names, class.pattern")
        kind, _, pattern = pieces[0].text.lower().partition(".")
        if kind in self.words.left_out:
            self.left_out["batchedit"] += 1
            return
        if kind not in self.words.classes or not pattern or not PATTERN.fullmatch(pattern):
            shown = printable(shortened(pieces[0].text, 40))
            raise _RefusedError(f"{shown!r} is no class and name, at most with one * at its end")
        if text := self._read_properties(kind, pieces[1:], path):
            self._hand_over(f"batchedit {kind}.{pattern} {text}")

    def _set(self, pieces: Sequence[_Piece]) -> None:
        for piece in pieces:
            word = self.words.options.find(piece.name) if piece.name else None
            if word is None:
                raise _RefusedError(
                    f"{printable(piece.name or piece.text)!r} is no option of OpenDSS; write option=value"
                )
            mark = self.words.options.marks[word]
            if mark == "refused":
                raise _RefusedError(f"the option {word} is refused: {WRITES}")
            if mark == "left out":
                self.left_out[f"set {word}"] += 1
            else:
                self._hand_over(f"set {_write(word, piece.text)}")

    def _switch(self, verb: str, pieces: Sequence[_Piece]) -> None:
        """Open, close, enable and disable: an object, and for the first two a terminal and a conductor."""
        if not pieces or pieces[0].name not in ("", "object"):
            raise _RefusedError("give an object, class.name")
        kind, name = _split_object(pieces[0].text)
        numbers = [piece.text for piece in pieces[1:]]
        if kind in self.words.left_out:
            return
        if kind not in self.words.classes:
            raise _RefusedError(f"the class {printable(kind)!r} is not read")
        if verb == "open" and kind not in SERIES:
            raise _RefusedError(f"a {kind} cannot be opened here, a {listed(list(SERIES))} can; write disable")
        if len(numbers) > 2 or not all(number.isdecimal() and len(number) < 3 for number in numbers):
            raise _RefusedError("beside the object give the number of a terminal, and of a conductor")
        self._hand_over(" ".join([verb, f"{kind}.{name}", *numbers]))

    def _place_buses(self, verb: str, pieces: Sequence[_Piece], path: Path) -> None:
        if verb == "setbusxy":
            given = {piece.name or key: piece.text for piece, key in zip(pieces, ("bus", "x", "y"), strict=False)}
            rows = [[given.get("bus", ""), given.get("x", ""), given.get("y", "")]]
        else:
            rows = self._read_places(self._find_file(_take_path(pieces), path))
        for row in rows:
            try:
                x, y = float(row[1]), float(row[2])
                if not math.isfinite(x + y):
                    raise ValueError
                self.script.places[row[0].lower()] = x, y
            except (ValueError, IndexError):
                raise _RefusedError(f"{printable(shortened(' '.join(row), 40))!r} is no bus with its x and y") from None

    def _read_places(self, path: Path) -> list[list[str]]:
        lines = (line.strip(" \t,;") for line in LINE_END.split(self._read_text(path)))
        kept = (line for line in lines if line and not line.startswith(("!", "//")))
        return [[_unquote(part) for part in self._split_row(line, r"[\s,;=]+", path)] for line in kept]


def _match(folder: Path, part: str) -> Path:
    """The entry of a folder: ``part``, or the one that differs in its case only."""
    path = folder / part
    if part in ("", ".", "..") or path.exists() or not folder.is_dir():
        return path
    same = [entry for entry in folder.iterdir() if entry.name.lower() == part.lower()]
    return same[0] if len(same) == 1 else path


def _split(line: str) -> Iterator[_Piece]:
    """The pieces of a line, as OpenDSS splits it, without the comment at its end."""
    at = 0
    while not END.match(line, at):
        found = PIECE.match(line, at)
        if not found:
            raise _RefusedError(
                f"cannot be read at {printable(shortened(line[at:], 20))!r}; close each quote and bracket"
            )
        name, quoted, plain = found["name"] or "", found["quoted"], found["plain"]
        if "//" in name or (plain and "//" in plain):  # a comment begins within the word
            begin = line.index("//", at)
            line = line[:begin]
            continue
        if plain is not None and (plain.startswith("@") or name.startswith("@")):
            raise _RefusedError("variables are not read; write the value in place of @")
        yield _Piece(name.lower(), plain if quoted is None else quoted[1:-1].strip(), quoted is not None)
        at = found.end()
        if at < len(line) and line[at] not in (" \t,!/" if quoted is not None else " \t,!="):
            raise _RefusedError(
                f"cannot be read at {printable(shortened(line[at:], 20))!r}; put blanks around brackets and quotes"
            )


def _split_object(text: str) -> tuple[str, str]:
    kind, _, name = text.lower().partition(".")
    if not NAME.fullmatch(name) or "//" in name or len(name) > LONGEST_WORD:
        raise _RefusedError(
            f"{printable(shortened(text, 40))!r} is no class.name of at most {LONGEST_WORD} letters, digits and signs"
        )
    return kind, name


def _at(words: Words, place: int) -> str | None:
    return words.order[place] if place < len(words.order) else None


def _write(word: str, text: str) -> str:
    """A property and its value for OpenDSS."""
    text = QUOTED_NAME.sub(r"\2", text)
    if not VALUE.fullmatch(text):
        odd = next(c for c in text if not VALUE.fullmatch(c))
        raise _RefusedError(f"the value of {word} holds {printable(odd)!r}; give plain names and numbers")
    if LONG_WORD.search(text):
        raise _RefusedError(f"{word} holds a word of more than {LONGEST_WORD} characters; give a shorter one")
    if word in BUSES and not all(BUS.fullmatch(bus) for bus in re.split(r"[\s,]+", text.strip(" \t,")) if bus):
        raise _RefusedError(f"the value of {word} is no name of a bus with its nodes, of one or two digits each")
    if word in MOST and not (re.fullmatch(r"\d{1,9}(\.0*)?", text) and float(text) <= MOST[word]):
        raise _RefusedError(f"{word} is a whole number of at most {MOST[word]:,} here")
    return f"{word}={text}" if PLAIN.fullmatch(text) else f"{word}=[{text}]"


def _take_path(pieces: Sequence[_Piece]) -> str:
    if len(pieces) != 1 or pieces[0].name not in ("", "file"):
        raise _RefusedError("give one file; a path with blanks stands in quotes")
    return pieces[0].text


def _unquote(text: str) -> str:
    return text.strip().strip("\"'")
