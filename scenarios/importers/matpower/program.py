"""A MATPOWER case file executed as a program: its matrices, after the conversions of units that follow them.

Statements other than the known ones are rejected, since they could change the data; readers that look for the matrices
only take the kW of ``case33bw`` for MW.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from dsse_core.printable import shortened

PD, QD, BASE_KV, BR_R, BR_X = 2, 3, 9, 2, 3  # columns
COLUMNS = {"bus": 13, "branch": 11, "gen": 10}
"""Matrix -> its least number of columns."""
MOST_COLUMNS = {"bus": 17, "branch": 21, "gen": 25}
"""Matrix -> number of columns that MATPOWER knows, results of an optimal power flow included."""
NOT_NEEDED = {"gencost", "areas", "gentype", "genfuel", "genid", "branch_name", "gen_name"}
"""Fields of ``mpc`` that change no power flow."""
NUMBERS = {"bus": (0, 1), "branch": (0, 1), "gen": (0,)}
"""Matrix -> its columns of bus numbers and types."""
NUMBER = r"[+-]?(?:\d++(?:\.\d*+)?+|\.\d++)(?:[eE][+-]?\d++)?+"
HARMLESS = re.compile(
    r"function\b.*|mpc\.version='?2'?|define_constants|end"
    r"|\[[A-Z_0-9,~ ]+\]=idx_(?:bus|brch|gen|cost)"
    r"|Vbase=mpc\.bus\(1,BASE_KV\)\*1e3|Sbase=mpc\.baseMVA\*1e6"
)
QUOTED = re.compile(r"""'(?:[^'\n]|'')*+'|"(?:[^"\n]|"")*+\"""")
PIECE = re.compile(r"""(?<![\w)\]}'".])'(?:[^'\n]|'')*+'|"(?:[^"\n]|"")*+"|%.*|.""")
"""A text in quotes, a comment, or any other character of a line; a ' after an operand transposes it."""
BASE_MVA = re.compile(rf"mpc\.baseMVA=({NUMBER})(?:/({NUMBER}))?")
CELL = re.compile(rf"({NUMBER})(?:/(?:({NUMBER})|sqrt\(({NUMBER})\)))?")  # 135/sqrt(3) is among them
POWER_FACTOR = re.compile(rf"pf=({NUMBER})")
OHM = "mpc.branch(:,[BR_R,BR_X])=mpc.branch(:,[BR_R,BR_X])/(Vbase^2/Sbase)"
KILOWATT = "mpc.bus(:,[PD,QD])=mpc.bus(:,[PD,QD])/1e3"
Q_OF_MVA = "mpc.bus(:,QD)=mpc.bus(:,PD)*sin(acos(pf))"
P_OF_MVA = "mpc.bus(:,PD)=mpc.bus(:,PD)*pf"

LONGEST_SHOWN = 80  # characters of a statement

Matrix = list[list[float]]
Given = TypeVar("Given")


@dataclass
class Case:
    """The program as far as executed. ``changes``: the conversions; ``left_out``: fields that are not read, though they
    may mean something; ``problems``: statements and rows that are not understood.
    """

    base_mva: float | None = None
    power_factor: float | None = None
    matrices: dict[str, Matrix] = field(default_factory=dict)
    bus_names: list[str] = field(default_factory=list)
    changes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def run_program(text: str) -> Case:
    """Execute a case file; ``problems`` holds, with line numbers, every statement that is not understood."""
    case = Case()
    for line, statement in _split_statements(text):
        _execute(case, statement, line)
    if not case.matrices and case.base_mva is None:
        return Case(problems=["this is no MATPOWER case: mpc.baseMVA, mpc.bus, mpc.branch and mpc.gen are all missing"])
    case.problems += [f"mpc.{name} is missing" for name in COLUMNS if name not in case.matrices]
    if case.base_mva is None:
        case.problems.append("mpc.baseMVA is missing")
    return case


def _split_statements(text: str) -> Iterator[tuple[int, str]]:
    """(line, statement) of a program: without comments, continued lines joined, brackets kept whole."""
    statement, start, depth = "", 0, 0
    is_blank = True  # the statement so far
    in_comment = False
    for number, raw in enumerate(text.splitlines(), start=1):
        if raw.strip() in ("%{", "%}"):
            in_comment = raw.strip() == "%{"
        if in_comment:
            continue
        pieces = _split_line(raw)
        continued = pieces[-3:] == ["."] * 3
        for piece in pieces[:-3] if continued else pieces:
            if is_blank:
                start = number
            depth += (piece in "[{(") - (piece in "]})")
            if piece == ";" and depth == 0:
                yield start, statement
                statement, is_blank = "", True
            else:
                statement += piece
                is_blank = is_blank and piece.isspace()
        if depth > 0:
            statement += " " if continued else "\n"
        elif not continued:
            yield start, statement
            statement, is_blank = "", True
    if not is_blank:
        yield start, statement


def _split_line(line: str) -> list[str]:
    """The pieces of a line, each a text in quotes or one character, without its comment and blanks at its end."""
    pieces = PIECE.findall(line)
    while pieces and (pieces[-1].startswith("%") or pieces[-1].isspace()):
        pieces.pop()
    return pieces


def _execute(case: Case, statement: str, line: int) -> None:
    """Execute a statement, or note that it is not understood."""
    name, equals, value = (part.strip() for part in statement.partition("="))
    if equals and (found := re.fullmatch(r"mpc\.(\w+)", name)) and value[:1] in ("[", "{"):
        if found[1] in COLUMNS:
            _take_matrix(case, found[1], value, line)
        elif found[1] == "bus_name":
            case.bus_names = [text[1:-1].replace(2 * text[0], text[0]) for text in QUOTED.findall(value)]
        elif found[1] in ("dcline", "if", "load", "softlims") and value.strip("[]{} \n"):
            case.problems.append(f"line {line}: mpc.{found[1]}: the network model cannot hold it; remove it")
        elif found[1] not in NOT_NEEDED:
            field_name = shortened(found[1], LONGEST_SHOWN)
            case.left_out.append(
                f"mpc.{field_name} (line {line}): a field that is not read; no power flow here needs it"
            )
        return
    plain = _normalised(statement)
    if not plain or HARMLESS.fullmatch(plain) or re.fullmatch(r"mpc\.(?!version)\w+='[^']*'", plain):
        return
    if found := BASE_MVA.fullmatch(plain):
        case.base_mva = _quotient(found[1], found[2] or "1")
        if not (math.isfinite(case.base_mva) and case.base_mva > 0):
            case.problems.append(f"line {line}: {_shown(plain)}: it must be a positive power in MVA")
    elif found := POWER_FACTOR.fullmatch(plain):
        case.power_factor = float(found[1])
        if not 0 <= case.power_factor <= 1:
            case.problems.append(f"line {line}: {_shown(plain)}: a power factor lies between 0 and 1")
    elif action := CONVERSIONS.get(plain):
        if not case.problems:  # numbers that are known to be wrong are not computed with
            try:
                case.changes.append(action(case))
            except ValueError as error:
                case.problems.append(f"line {line}: {_shown(plain)}: {error}")
    else:
        case.problems.append(
            f"line {line}: {_shown(plain)} is a statement that this reader does not know and that could change the "
            "data; run the case in MATPOWER, save it with savecase, and import that file"
        )


def _shown(text: str) -> str:
    """``text`` in quotes as a terminal may show it: on one line, unprintable characters escaped, long ones cut."""
    plain = ascii(text) if not text.isprintable() else repr(text)
    return plain if len(plain) <= LONGEST_SHOWN else plain[:LONGEST_SHOWN] + "..." + plain[0]


def _normalised(statement: str) -> str:
    """``statement`` without blanks; between items of a list they become commas."""
    text = re.sub(r"\s*,\s*|(?<=[\w\]])\s+(?=\w)", ",", " ".join(statement.split()))
    if text.startswith("function"):
        return text
    return text.replace(" ", "")


def _take_matrix(case: Case, name: str, text: str, line: int) -> None:
    rows: Matrix = []
    inside = text.strip().removeprefix("[").removesuffix("]")
    for offset, raw in enumerate(inside.split("\n")):
        for part in raw.split(";"):
            if cells := part.replace(",", " ").split():
                numbers = [_number(cell) for cell in cells]
                row = [number for number in numbers if number is not None]
                found = _find_row_problems(name, cells, row, len(rows[0]) if rows else None)
                case.problems += [f"line {line + offset}: mpc.{name}: {problem}" for problem in found]
                if len(row) == len(cells):
                    rows.append(row)
    if not inside.strip():
        case.problems.append(f"line {line}: mpc.{name} is empty")
    if rows and (beyond := len(rows[0]) - MOST_COLUMNS[name]) > 0:
        case.left_out.append(f"mpc.{name} (line {line}): the last {beyond} columns, which MATPOWER does not know")
    case.matrices[name] = rows


def _find_row_problems(name: str, cells: Sequence[str], row: Sequence[float], width: int | None) -> Iterator[str]:
    """Problems of a row of matrix ``name``.

    ``row``: those of its ``cells`` that are numbers; ``width``: of the first row.
    """
    if len(row) < len(cells):
        yield f"a row holds more than numbers: {_shown(' '.join(cells))}"
        return
    if not all(row[column].is_integer() for column in NUMBERS[name] if column < len(row)):
        yield "a bus number or type is no integer"
    if len(row) < COLUMNS[name]:
        yield f"a row has {len(row)} columns, at least {COLUMNS[name]} are needed (version 2)"
    elif width is not None and len(row) != width:
        yield f"a row has {len(row)} columns, the first has {width}; give all the same"
    if bad := [cell for cell, number in zip(cells, row, strict=True) if math.isnan(number)]:
        yield f"{_shown(bad[0])} is no number that can be computed with; correct it"


def _number(cell: str) -> float | None:
    if cell in ("Inf", "-Inf", "NaN"):  # limits, which power flow does not use, may be infinite
        return float(cell)
    if (found := CELL.fullmatch(cell)) is None:
        return None
    if found[3] is not None:
        root = float(found[3])
        return float(found[1]) / math.sqrt(root) if root > 0 else math.nan
    return _quotient(found[1], found[2] or "1")


def _quotient(above: str, below: str) -> float:
    """The quotient; nan for a division by zero, which MATPOWER executes but no computation here can use."""
    return float(above) / float(below) if float(below) else math.nan


def _ohm_to_pu(case: Case) -> str:
    base_kv = _given(case.matrices.get("bus"), "mpc.bus")[0][BASE_KV]
    z_base = base_kv * base_kv / _given(case.base_mva, "mpc.baseMVA")
    if not 0 < z_base < math.inf:
        raise ValueError(f"the first bus has a base voltage of {base_kv:g} kV; ohms need a positive one")
    for row in _given(case.matrices.get("branch"), "mpc.branch"):
        row[BR_R] /= z_base
        row[BR_X] /= z_base
    return "branch impedances from ohm to p.u., as the case file says"


def _kw_to_mw(case: Case) -> str:
    for row in _given(case.matrices.get("bus"), "mpc.bus"):
        row[PD], row[QD] = row[PD] / 1e3, row[QD] / 1e3
    return "loads from kW and kvar to MW and Mvar, as the case file says"


def _q_of_mva(case: Case) -> str:
    factor = math.sin(math.acos(_given(case.power_factor, "pf")))
    for row in _given(case.matrices.get("bus"), "mpc.bus"):
        row[QD] = row[PD] * factor
    return f"reactive loads from MVA by the power factor {case.power_factor}, as the case file says"


def _p_of_mva(case: Case) -> str:
    factor = _given(case.power_factor, "pf")
    for row in _given(case.matrices.get("bus"), "mpc.bus"):
        row[PD] *= factor
    return f"active loads from MVA by the power factor {case.power_factor}, as the case file says"


def _given(value: Given | None, name: str) -> Given:
    if value is None:
        raise ValueError(f"no line before it gives {name}")
    return value


CONVERSIONS: dict[str, Callable[[Case], str]] = {
    OHM: _ohm_to_pu,
    KILOWATT: _kw_to_mw,
    Q_OF_MVA: _q_of_mva,
    P_OF_MVA: _p_of_mva,
}
