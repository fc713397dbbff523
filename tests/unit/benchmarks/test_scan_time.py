"""The benchmark of processor time takes some for every scan, and stops where a scan does not end."""

import click
import pytest
from click.testing import CliRunner

from benchmarks import scan_time
from benchmarks.exchange.worlds import draw_row

pytestmark = pytest.mark.slow


def test_every_scan_takes_processor_time():
    times = scan_time.time_scans(draw_row(3), 4)
    assert times.cold > 0
    assert len(times.warm) == 3
    assert min(times.warm) > 0


def test_a_scan_without_an_end_is_an_error(monkeypatch):
    monkeypatch.setattr(scan_time, "LIMIT_S", scan_time.STEP_S)
    with pytest.raises(click.ClickException, match="no end within"):
        scan_time.time_scans(draw_row(3), 2)


def test_a_line_for_each_case():
    done = CliRunner().invoke(scan_time.main, ["--scans", "2", "--row", "2"])
    assert done.exit_code == 0, done.output
    assert [line.split(" | ")[0] for line in done.output.splitlines()[-2:]] == ["| ieee33", "| 2 areas in a row"]
