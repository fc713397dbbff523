"""Texts of OpenDSS: what a hostile file tries is refused by line, and what is handed over is written anew."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dsse_core.errors import InvalidInputError
from scenarios.importers.opendss import script
from scenarios.importers.opendss.script import MOST_BYTES, MOST_LINES, MOST_STATEMENTS, read_script
from tests.support.levels import further

CIRCUIT = """clear
new circuit.toy basekv=4.16  ! a comment
new line.l1 bus1=sourcebus bus2=b length=1
new load.a bus1=b kw=10 kv=4.16
"""
HANDED_OVER = re.compile(
    r"(?:new (?:circuit|linecode|line|load|transformer|loadshape|generator|capcontrol)\.[\w.+#/%&$:;~-]+"
    r"|edit [a-z]+\.[\w.+-]+|batchedit [a-z]+\.[\w.*+-]+|set)"
    r"(?: [a-z%][\w%-]*=(?:[\w.+-]+|\[[\w.+\-#/%&$:;~^*|,() \t]*\]))* ?"
    r"|solve|calcvoltagebases|(?:open|close|enable|disable) [a-z]+\.\S+(?: \d+)*|setkvbase bus=\S+ kvl[ln]=\S+",
    re.ASCII,
)


def write(folder: Path, text: str, name: str = "feeder.dss") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode("utf-8"))
    return path


def refuse(path: Path, within: Path | None = None) -> list[str]:
    with pytest.raises(InvalidInputError) as error:
        read_script(path, within)
    return list(error.value.problems)


HOSTILE = [
    "export voltages written.csv",
    "new generator.g bus1=b kw=1 kv=4.16 model=6 usermodel=./any.so",
    "new generator.g bus1=b userm=./any.so",
    "redirect ../other.dss",
    "mult=(file=/etc/passwd)",
    "mult=[file=x " + "a" * 60_000 + "]",
    "mult=[file=x col=" + "a" * 60_000 + "!]",
    "mult=[file=x, col=0]",
    "mult=[file=x, col=" + "9" * 5000 + "]",
    "set " + "loadmult=1 " * 1001,
    "batchedit load.a*a*b$ kw=1",
    "batchedit load.a+a+b kw=1",
    "new linecode.c nphases=3000",
    "new load.b phases=100000000",
    "new loadshape.s npts=2000000000",
    "new loadshape.s npts=(2 3 *)",
    "open load.a",
    "edit vsource.source sequence=neg",
    "new generator.g bus1=b dispmode=price",
    "new storage.s bus1=b dischargetrigger=0.5",
    "new line.l2 bus1=b1(b9)",
    "new line.l2 bus1=[b1(b9)]",
    "new line.l2 bus1=b.99999999.5.6",
    "new line.l2 bus1=" + "b" * 256,
    "new line." + "b" * 256,
    '"" load.b bus1=b',
    "setbusxy bus=b x=nan y=1",
    *further(
        "EXPO voltages",
        "'export' voltages",
        '"exp" voltages',
        "[save] circuit dir=/tmp/x",
        "sho voltages",
        "plot circuit",
        "visualize what=currents element=line.l1",
        "dump line.l1",
        "fileedit feeder.dss",
        "doscmd touch /tmp/x",
        "cd /tmp",
        "closedi",
        "var @x=export",
        "@x voltages",
        "new load.b bus1=@x",
        "set datapath=/tmp",
        "set dat=/tmp",
        "set editor=/bin/sh",
        "set recorder=yes",
        "solve datapath=/tmp",
        "set /tmp",
        "compile /etc/passwd",
        "compile C:\\windows\\win.ini",
        "redirect \\\\server\\share\\x.dss",
        "redirect ~/x.dss",
        "redirect sub/../../x.dss",
        "redirect missing.dss",
        "redirect (a b) c",
        "buscoords ../places.csv",
        "buscoords /etc/passwd",
        "setbusxy bus=b x=1 y=two",
        "edit generator.g usermodel=x",
        "generator.g.usermodel=x",
        "generator.g.shaftm=x",
        "batchedit generator..* userdata=x",
        "batchedit generator.(x|y) kw=1",
        "new generator.g 3 b 4.16 1 1 1 1 1 1 a b c d e w f f 1 1 1 1 y 1 1 1 1 1 1 1 ./any.so",
        "new capcontrol.c line.l1 1 cap kvar 1 1 1 1 1 y 1 1 1 1 1 1 b n ./any.so",
        "new storage.s bus1=b dynadll=x",
        "new pvsystem.p bus1=b usermodel=x",
        "new capcontrol.c usermodel=x",
        "new loadshape.s csvfile=/etc/passwd",
        "new loadshape.s mult=[sngfile=x.sng]",
        "new loadshape.s dblfile=x.dbl",
        "new loadshape.s npts=2 mult=(1 2) action=dblsave",
        "new loadshape.s mult=(file=../x.csv, col=2)",
        "new loadshape.s mult=(file=x.csv, run=2)",
        "new linecode.c rmatrix=(file=x.csv)",
        'new linecode.c rmatrix="file=x.csv"',
        "new transformer.t buses=[file=x.txt]",
        "new xycurve.x csvfile=x.csv",
        "new spread.x a=1",
        "new fault.f bus1=b",
        "new dynamicexp.x expression=1",
        "new type=generator name=g usermodel=x",
        "new circuit.second",
        "new vsource.source",
        "edit",
        "new load.'a b' kw=1",
        "new load.a{b kw=1",
        "new load.b bus1=[b kw=1",
        "new load.b bus1=b] kw=1",
        'new load.b bus1="b"kw=1',
        "new load.b bus1=b\\c",
        "new load.b bus1=b\N{LATIN SMALL LETTER A WITH DIAERESIS}",
        "new load.b bus1=[b\N{FULLWIDTH QUOTATION MARK} ]",
        "new load.b unknown=1",
        "open line.l1 one",
        "open monitors/x.txt",
        "allocateloads",
        "setkvbase b",
        "reset monitors",
    ),
]


@pytest.mark.parametrize("statement", HOSTILE)
def test_a_statement_that_may_write_load_or_read_elsewhere_is_refused_by_its_line(tmp_path: Path, statement) -> None:
    line = f"new loadshape.s {statement}" if statement.startswith("mult=") else statement
    path = write(tmp_path, CIRCUIT + line + "\nsolve\n")
    problems = refuse(path)
    assert len(problems) == 1
    assert problems[0].startswith("feeder.dss line 5: ")


@pytest.mark.parametrize("verb", ["open line.l1 1", "disable line.l1", *further("set element=line.l1", "solve")])
def test_what_may_turn_opendss_to_another_element_ends_the_continuations(tmp_path: Path, verb: str) -> None:
    problems = refuse(write(tmp_path, f"{CIRCUIT}{verb}\n~ length=2\n"))
    assert [problem.split(":")[0] for problem in problems] == ["feeder.dss line 6"]


def test_a_file_of_too_many_lines_is_refused(tmp_path: Path) -> None:
    assert refuse(write(tmp_path, "\n" * (MOST_LINES + 1))) == [f"more than {MOST_LINES:,} lines are read"]


def test_numbers_of_files_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "MOST_PIECES", 100)
    write(tmp_path, "1\n" * 101, "many.csv")
    write(tmp_path, "1," * script.LONGEST_ROW, "long.csv")
    text = CIRCUIT + "".join(f"new loadshape.{name} csvfile={name}.csv\n" for name in ("long", "many"))
    assert [re.findall("line 5|line 6|characters|values", problem) for problem in refuse(write(tmp_path, text))] == [
        ["line 5", "characters"],
        ["line 6", "values"],
    ]


def test_continuations_abbreviations_and_comments_hide_nothing(tmp_path: Path) -> None:
    text = CIRCUIT + (
        "/* a comment of lines\nexport one.csv\n*/ export two.csv\n"
        "// export three.csv\nnew generator.g bus1=b // usermodel=x\n~ conn=wye ! usermodel=x\n"
        "~ usermod=x.so\nm shaftdata=y\nshow voltages ! harmless\n"
    )
    problems = refuse(write(tmp_path, text))
    assert [re.findall(r"line (\d+)", problem) for problem in problems] == [["11"], ["12"], ["13"]]
    assert ["usermodel" in problems[0], "shaftdata" in problems[1], "verb show" in problems[2]] == [True] * 3


@pytest.mark.parametrize("end", ["\r\n", "\r", *further("\n")])
def test_every_kind_of_line_end_ends_a_line(tmp_path: Path, end: str) -> None:
    problems = refuse(write(tmp_path, f"! a comment{end}export x.csv{end}"))
    assert problems == [
        "feeder.dss line 2: export x.csv: the verb export is refused: OpenDSS may write files, run programs or change "
        "with it what is imported; take the line out"
    ]


@pytest.mark.parametrize("character", ["\0", *further("\x1b", "\x0b", "\x0c", "\x7f")])
def test_a_file_that_is_no_text_is_refused(tmp_path: Path, character: str) -> None:
    problems = refuse(write(tmp_path, f"clear\n! {character}\n"))
    assert problems == [f"line 2: holds the character {character!r}; this is no text"]


def test_redirects_in_circles_too_deep_or_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "redirect b/second.dss\n", "a/first.dss")
    write(tmp_path, "! back\nredirect ../first.dss\n", "a/b/second.dss")
    assert "line 2: redirect ../first.dss: first.dss is being read already" in refuse(tmp_path / "a" / "first.dss")[0]
    for k in range(30):
        write(tmp_path, f"redirect deep{k + 1}.dss\n", f"deep{k}.dss")
    assert "nested more than 20 deep" in refuse(tmp_path / "deep0.dss")[0]
    write(tmp_path, "new circuit.x\n", "secret.dss")
    (tmp_path / "a" / "link.dss").symlink_to(tmp_path / "secret.dss")
    for name in ("../secret.dss", "link.dss"):
        problems = refuse(write(tmp_path, f"redirect {name}\n", "a/out.dss"))
        assert f"lies outside the folder {tmp_path / 'a'}" in problems[0]
        assert read_script(tmp_path / "a" / "out.dss", tmp_path).name == "x"
    assert "lies outside the folder" in refuse(tmp_path / "secret.dss", tmp_path / "a")[0]


def test_redirects_that_double_each_time_are_refused(tmp_path: Path) -> None:
    for k in range(19):
        write(tmp_path, f"redirect f{k + 1}.dss\n" * 2, f"f{k}.dss")
    write(tmp_path, "clear\n", "f19.dss")
    assert any("2000 files" in problem for problem in refuse(tmp_path / "f0.dss"))


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, "clear\n")
    with path.open("r+b") as file:
        file.truncate(100 * 2**20)
    assert refuse(path) == [
        f"cannot be read: has {100 * 2**20:,} bytes, the limit is {MOST_BYTES:,}; give a smaller file"
    ]


@pytest.mark.long
def test_a_file_of_too_many_statements_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, CIRCUIT + "~ kw=1\n" * MOST_STATEMENTS)
    assert any(f"more than {MOST_STATEMENTS:,} statements" in problem for problem in refuse(path))


def test_many_problems_end_the_reading(tmp_path: Path) -> None:
    problems = refuse(write(tmp_path, "export x\n" * 1000))
    assert (len(problems), problems[-1]) == (51, "there may be more; the rest is not read")


def test_a_circuit_is_written_anew_with_full_names_and_plain_values(tmp_path: Path) -> None:
    write(tmp_path, "0.5\r\n1.0\r\n\r\n", "shapes/one.csv")
    write(tmp_path, "hour, value\n0, 0.1\n1, 0.2\n", "shapes/two.csv")
    write(tmp_path, "b, 1.5, 2\n! none\nSourceBus 3 4\n", "Places.CSV")
    text = """// made up
    CLEAR
    Set DefaultBaseFreq=60
    new circuit.gone
    new line.gone bus1=x
    clear
    Set mode=daily
    New "Circuit.Toy" basekv=4.16 pu=(1 2 /)

    new object=linecode.C 3 0.1 Rmat=(0.1 | 0.2 0.3) units=km faultrate=3
    ~ c1 = 5 , 6
    New Line.L1 sourcebus b.1.2.3 c length = 1.5 !comment
    new transformer.t buses=("b.1" 'c.1') conns='wye wye' %r = .5 ppm=0
    new loadshape.s 2 mult=(file="shapes\\one.csv") action=normalize
    new loadshape.u npts=2 mult=[file=SHAPES/two.csv, col=2, header=yes]
    new monitor.m line.l1 1
    ~ mode=1
    new load.a bus1=b kw=10 kvar=-3 yearly=s
    load.a.kw=11 kvar=4
    batchedit load..* vminp=0.8
    Buscoords places.csv
    setkvbase b kvll=4.16
    set voltagebases=[4.16, 0.48]
    calcv
    open Line.L1 1 0
    solve mode=snap
    """
    read = read_script(write(tmp_path, text))
    assert [command.text for command in read.commands] == [
        "set defaultbasefrequency=60",
        "new circuit.toy basekv=4.16 pu=[1 2 /]",
        "new linecode.c nphases=3 r1=0.1 rmatrix=[0.1 | 0.2 0.3] units=km",
        "edit linecode.c c1=5 c0=6",
        "new line.l1 bus1=sourcebus bus2=b.1.2.3 linecode=c length=1.5",
        "new transformer.t buses=[b.1 c.1] conns=[wye wye] %r=.5 ppm_antifloat=0",
        "new loadshape.s npts=2 mult=[0.5 1.0] action=normalize",
        "new loadshape.u npts=2 mult=[0.1 0.2]",
        "new load.a bus1=b kw=10 kvar=-3 yearly=s",
        "edit load.a kw=11 kvar=4",
        "batchedit load..* vminpu=0.8",
        "setkvbase bus=b kvll=4.16",
        "set voltagebases=[4.16, 0.48]",
        "calcvoltagebases",
        "open line.l1 1 0",
        "solve",
    ]
    assert all(HANDED_OVER.fullmatch(command.text) for command in read.commands)
    assert read.places == {"b": (1.5, 2.0), "sourcebus": (3.0, 4.0)}
    assert [remark.text for remark in read.remarks] == [
        "set mode (2), monitor (1): no power flow needs it",
    ]
    assert read.commands[4].place == "feeder.dss line 12"


def test_a_circuit_is_required(tmp_path: Path) -> None:
    assert "no circuit" in refuse(write(tmp_path, "clear\n"))[0]
    assert "begin with 'new circuit.NAME'" in refuse(write(tmp_path, "new line.a bus1=x\n"))[0]
