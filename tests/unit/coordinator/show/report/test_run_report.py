"""``report.html`` of runs: what stands in it, that foreign text is text, that it asks for nothing."""

from __future__ import annotations

import errno
import io
import itertools
import re
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import coordinator
from coordinator.lab.evaluation.result import RunResult
from coordinator.show.figures.run_figures import draw_run
from coordinator.show.figures.style import Drawing
from coordinator.show.report import page as page_module
from coordinator.show.report.page import render_page
from coordinator.show.report.run_report import make_run_page, write_report
from coordinator.show.report.settings import write_command
from dsse_core.printable import printable
from scenarios.scenario import load_scenario
from tests.support.levels import further
from tests.support.made_results import make_result
from tests.support.read_page import ReadPage, read_page

pytestmark = pytest.mark.slow  # drawing takes seconds
HOSTILE = "<script>alert(1)</script>&\"'><img src=http://evil.example/x>"
CHANGES = {"faults.loss": 0.3, "areas": {"count": 4}}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return make_result(load_scenario("ieee33", changes=CHANGES), tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def drawings(result: RunResult) -> tuple[Drawing, ...]:
    return draw_run(result)


@pytest.fixture(scope="module")
def page(result: RunResult, drawings: tuple[Drawing, ...]) -> ReadPage:
    arguments = ["run", "ieee33", "--set", "faults.loss=0.3", "--set", "areas={count=4}", "--out", "old"]
    return read_page(render_page(make_run_page(result, drawings, arguments)))


def test_a_report_says_the_verdict_the_tables_and_how_to_repeat_it(page: ReadPage, result: RunResult) -> None:
    assert "Consensus after 4.00 s" in page.text
    for words in ("Gaps and errors", "decentralised to centralised (same telemetry)", "Power of the areas (4)"):
        assert words in page.text
    for words in ("Buses (33)", "Branches (37)", "Meters (134)", "voltage (kV)", "current (A)", "active injection"):
        assert words in page.text
    assert f"{result.buses.vm_pu[17]:.5f}" in page.text
    assert "dsse run ieee33 --set faults.loss=0.3 --set 'areas={count=4}' --out NEW_FOLDER" in page.text
    assert page.count("svg") == 6


def test_a_report_has_settings_changes_the_scenario_file_and_versions(page: ReadPage, result: RunResult) -> None:
    assert "Changed from the scenario file faults.loss 0.3 areas {count=4}" in page.text
    assert "faults of links loss 0.3" in page.text
    assert f"scenario file {result.scenario.path}" in page.text
    assert 'network = "ieee33"' in page.text
    for name in ("Python", "consensus-dsse", "numpy", "matplotlib", "jinja2"):
        assert re.search(rf"{name} \d", page.text), name


def test_a_run_without_consensus_says_why(result: RunResult, drawings: tuple[Drawing, ...]) -> None:
    verdict = replace(result.verdict, consensus=False, reason="area2 has no estimate\nits log ends")
    text = read_page(render_page(make_run_page(replace(result, verdict=verdict), drawings, []))).text
    assert "NO CONSENSUS after 4.00 s" in text
    assert "area2 has no estimate its log ends" in text


def test_a_report_refers_to_nothing_outside_itself(page: ReadPage) -> None:
    assert len(page.references) > 100
    assert [to for to in page.references if not to.startswith(("#", "data:"))] == []
    assert page.count("script") == 0
    policies = [a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; style-src 'unsafe-inline'; img-src data:"]
    styles = " ".join(a.get("style", "") for _, a in page.elements)
    assert re.findall(r"url\((?!#)", styles) == []


def test_every_reference_inside_a_report_has_its_target_and_no_id_stands_twice(page: ReadPage) -> None:
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    wanted = {to.removeprefix("#") for to in page.references if to.startswith("#")}
    assert wanted <= set(ids)
    outside_of_figures = [
        name for name in ids if not re.match(r"(gap|errors|magnitudes|angles|residuals|network)-", name)
    ]
    assert len(outside_of_figures) == len(set(outside_of_figures))
    assert page.mismatched == []
    assert page.open_tags == []


def test_a_report_can_be_read_with_the_keyboard_and_aloud(page: ReadPage) -> None:
    figures = [a for tag, a in page.elements if a.get("role") == "img"]
    assert len(figures) == 6
    assert all(len(a["aria-label"]) > 40 for a in figures)
    scrolled = [a for _, a in page.elements if a.get("class") == "scroll"]
    assert all(a["tabindex"] == "0" and a["role"] == "region" and a["aria-label"] for a in scrolled)
    assert all("scope" in a for tag, a in page.elements if tag == "th")
    assert ("html", {"lang": "en"}) in page.elements
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert all(after - before <= 1 for before, after in itertools.pairwise(levels))


@pytest.mark.parametrize(
    "name", [HOSTILE, *further("\udcff", "{{ 7 * 7 }}", "a\x1b[2Jb", "turned \u202e round", "$\\frac$")]
)
def test_foreign_text_is_text_in_a_report(result: RunResult, name: str) -> None:
    scenario = result.scenario
    network = replace(
        scenario.network, name=name, buses=tuple(replace(bus, name=name) for bus in scenario.network.buses)
    )
    partition = replace(scenario.partition, network=network)
    named = replace(
        result,
        run=name,
        scenario=replace(scenario, name=name, description=name, path=Path(name), network=network, partition=partition),
        area_results=tuple(replace(area, notes=(name,), quality=name) for area in result.area_results),
        verdict=replace(result.verdict, consensus=False, reason=name),
    )
    html = render_page(make_run_page(named, draw_run(named), ["run", name]))
    html.encode("utf-8")
    read = read_page(html)
    assert printable(name) in " ".join(read.words)
    assert read.count("script") == 0
    assert read.count("img") == 0
    assert [to for to in read.references if not to.startswith(("#", "data:"))] == []
    assert read.text.isprintable()
    assert read.mismatched == []


def test_a_long_table_says_how_many_rows_it_leaves_out(result: RunResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.show.report.run_report.MAX_ROWS", 26)
    made = make_run_page(result, (), [])
    assert [len(table.rows) for table in made.more_tables] == [26, 26, 26]
    text = read_page(render_page(made)).text
    assert "7 rows more are in the file." in text
    assert "Buses (33)" in text


def test_a_scenario_file_that_is_gone_is_no_obstacle(result: RunResult, drawings: tuple[Drawing, ...]) -> None:
    gone = replace(result, scenario=replace(result.scenario, path=Path("gone.toml")))
    text = read_page(render_page(make_run_page(gone, drawings, []))).text
    assert "it cannot be read any more: No such file or directory" in text


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        (["run", "ieee33"], "dsse run ieee33"),
        (["run", "my grid.toml", "--out", "runs/x"], "dsse run 'my grid.toml' --out NEW_FOLDER"),
        (["sweep", "a", "--out=x", "--vary", "k=1,2"], "dsse sweep a --out=NEW_FOLDER --vary k=1,2"),
    ],
)
def test_the_command_to_repeat_is_that_which_was_given_with_a_new_folder(given: list[str], shown: str) -> None:
    assert write_command(given) == shown


def test_what_cannot_be_written_is_named_by_the_result(tmp_path: Path) -> None:
    made = make_result(load_scenario("industrial13"), tmp_path)
    (tmp_path / "report.html").mkdir()
    unwritten = write_report(made, ["png"], []).unwritten
    assert unwritten is not None
    assert "report.html: Is a directory" in unwritten


def test_formats_are_those_that_are_asked_for(dsse, tmp_path: Path) -> None:
    out = tmp_path / "both"
    assert dsse("simulate", "industrial13", "--quiet", "--out", out, "--format", "pdf, svg")[0] == 0
    assert {path.suffix for path in out.iterdir()} == {".csv", ".json", ".jsonl", ".html", ".pdf", ".svg"}
    assert (out / "gap.pdf").read_bytes().startswith(b"%PDF")
    assert "<text" in (out / "gap.svg").read_text()  # as text, not as outlines
    assert f"dsse simulate industrial13 --quiet --out {'NEW_FOLDER'} --format" in (out / "report.html").read_text()


def test_no_plots_leaves_out_figures_and_report(dsse, tmp_path: Path) -> None:
    assert dsse("simulate", "industrial13", "--quiet", "--out", tmp_path / "a", "--no-plots")[0] == 0
    assert {path.suffix for path in (tmp_path / "a").iterdir()} == {".csv", ".json", ".jsonl"}


def test_formats_that_there_are_not_are_one_error_before_anything_runs(dsse, tmp_path: Path) -> None:
    code, _, err = dsse("simulate", "industrial13", "--out", tmp_path / "a", "--format", "pdf,bmp")
    assert code == 2
    assert "'bmp': choose of png, pdf, svg" in err
    code, _, err = dsse("simulate", "industrial13", "--out", tmp_path / "a", "--format", "pdf", "--no-plots")
    assert code == 2
    assert "give one of them" in err
    assert not (tmp_path / "a").exists()


def test_a_full_disk_while_the_report_is_written_is_one_error_and_leaves_no_half_of_it(
    dsse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(path: Path, text: str, encoding: str) -> None:
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(page_module.Path, "write_text", write)
    monkeypatch.setattr("coordinator.lab.evaluation.result.write_json", lambda *_: None)
    code, out, err = dsse("simulate", "industrial13", "--quiet", "--out", tmp_path / "a")
    assert code == 2
    assert out.startswith("consensus")
    assert err.count("error: ") == 1
    assert "report.html: No space left on device" in err
    assert not (tmp_path / "a" / "report.html").exists()


def test_a_full_disk_while_figures_are_written_leaves_no_half_of_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(figure: Figure, path: Path | io.StringIO, **_: object) -> None:
        if isinstance(path, Path):
            path.write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        path.write("<svg></svg>")

    monkeypatch.setattr(Figure, "savefig", save)
    unwritten = write_report(make_result(load_scenario("industrial13"), tmp_path), ["png"], []).unwritten
    assert unwritten == f"{tmp_path / 'gap.png'}: No space left on device"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_a_run_from_python_says_the_command_that_repeats_it(tmp_path: Path) -> None:
    scenario = load_scenario("industrial13", changes={"faults.loss": 0.1})
    coordinator.simulate(scenario, seed=3, out=tmp_path / "a", formats=["svg"], links={"delay_s": 0.02})
    text = read_page((tmp_path / "a" / "report.html").read_text(encoding="utf-8")).text
    command = f"dsse simulate {scenario.path} --seed 3 --strategy information --timeout 30 --set faults.loss=0.1"
    assert f"{command} --delay-ms 20" in text
    assert (tmp_path / "a" / "gap.svg").exists()
