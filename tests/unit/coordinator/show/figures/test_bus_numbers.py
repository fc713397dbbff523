"""Numbers of buses in pictures of networks: those of boundary buses at any size, none over another."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from coordinator.show.figures.draw_areas import make_areas_figure
from coordinator.show.figures.style import styled
from dsse_core.grid.partition import Partition
from scenarios.generate.generated_files import write_generated
from scenarios.scenario import load_scenario

pytestmark = pytest.mark.slow  # drawing takes seconds


def numbers_in(figure: Figure) -> list[Annotation]:
    texts = [text for text in figure.axes[0].texts if isinstance(text, Annotation)]
    return [text for text in texts if text.get_text().isdigit()]


def find_overlaps(figure: Figure) -> list[tuple[str, str]]:
    boxes = [(text.get_text(), text.get_window_extent()) for text in numbers_in(figure)]
    return [
        (one, other)
        for (one, box), (other, of_other) in combinations(boxes, 2)
        if min(box.x1, of_other.x1) - max(box.x0, of_other.x0) > 1
        and min(box.y1, of_other.y1) - max(box.y0, of_other.y0) > 1
    ]


def draw(partition: Partition) -> Figure:
    with styled():
        figure = make_areas_figure(partition)
        figure.draw_without_rendering()
        return figure


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Partition:
    path = write_generated(tmp_path_factory.mktemp("feeder"), 1000, 3, n_area=100, meters="sparse")
    return load_scenario(path).partition


def test_all_buses_of_a_small_network_have_their_numbers_and_none_covers_another() -> None:
    figure = draw(load_scenario("ieee33").partition)
    assert sorted(int(text.get_text()) for text in numbers_in(figure)) == list(range(1, 34))
    assert find_overlaps(figure) == []


def test_boundary_buses_of_a_large_network_have_their_numbers_and_none_covers_another(large: Partition) -> None:
    figure = draw(large)
    shown = {int(text.get_text()) for text in numbers_in(figure)}
    assert large.boundaries.keys() <= shown
    assert len(shown) < 200
    assert find_overlaps(figure) == []


def test_a_picture_of_areas_takes_its_format_from_its_name(tmp_path: Path) -> None:
    from coordinator.show.figures.draw_areas import draw_areas

    partition = load_scenario("industrial13").partition
    for name, start in (("a.svg", b"<?xml"), ("a.b.pdf", b"%PDF"), ("c.png", b"\x89PNG")):
        draw_areas(partition, tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    assert np.all([path.name in ("a.svg", "a.b.pdf", "c.png") for path in tmp_path.iterdir()])
