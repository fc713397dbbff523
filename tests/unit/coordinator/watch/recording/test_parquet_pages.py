"""Sizes of pages are read from the pages themselves, and whatever stands there costs linear work."""

from __future__ import annotations

import io
import random
from pathlib import Path

import pyarrow
import pyarrow.parquet
import pytest

from coordinator.watch.recording.parquet_pages import LONGEST_HEADER, Page, read_pages

COUNT = 3000


@pytest.fixture(params=["1.0", "2.0"])
def table(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "t.parquet"
    words = [f"word {k % 7}" for k in range(COUNT)]
    columns = {"number": pyarrow.array([k / 7 for k in range(COUNT)]), "word": pyarrow.array(words)}
    pyarrow.parquet.write_table(
        pyarrow.table(columns), path, compression="zstd", data_page_version=request.param, data_page_size=2000
    )
    return path


def find_places(path: Path) -> list[tuple[int, int]]:
    """Begin and end of each column."""
    group = pyarrow.parquet.read_metadata(path).row_group(0)
    chunks = [group.column(k) for k in range(group.num_columns)]
    begins = [min(c.data_page_offset, c.dictionary_page_offset or c.data_page_offset) for c in chunks]
    return [(begin, begin + chunk.total_compressed_size) for begin, chunk in zip(begins, chunks, strict=True)]


def test_pages_have_the_values_and_sizes_of_their_column(table: Path) -> None:
    group = pyarrow.parquet.read_metadata(table).row_group(0)
    with table.open("rb") as file:
        for k, place in enumerate(find_places(table)):
            pages = list(read_pages(file, *place))
            chunk = group.column(k)
            in_dictionary = pages[0].values if chunk.has_dictionary_page else 0
            assert sum(page.values for page in pages) == COUNT + in_dictionary
            headers = chunk.total_uncompressed_size - sum(page.size for page in pages)
            assert 0 < headers < LONGEST_HEADER * len(pages)


def test_bytes_that_are_no_pages_are_a_value_error_or_pages_that_end_with_their_column(table: Path) -> None:
    content, (begin, end) = table.read_bytes(), find_places(table)[0]
    draw = random.Random(1)
    for _ in range(500):
        changed = bytearray(content)
        for place in draw.choices(range(begin, end), k=3):
            changed[place] = draw.randrange(256)
        try:
            pages = list(read_pages(io.BytesIO(bytes(changed)), begin, end))
        except ValueError:
            continue
        assert all(page.size >= 0 and page.values >= 0 for page in pages)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x15",  # a field without a value
        b"\x00",  # no sizes
        b"\x15\x00\x15\x01\x15\x00\x00",  # a size below zero
        b"\x1c" * 100,  # structs in structs
        b"\x19\xf5" + b"\xff" * 20,  # a list without end
        b"\x15" + b"\xff" * 20,  # an integer without end
        b"\x18" + b"\xff" * 8 + b"\x01",  # a text without end
    ],
)
def test_what_no_header_has_is_a_value_error(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"page"):
        list(read_pages(io.BytesIO(content), 0, 1000))


def test_many_small_pages_are_read_once() -> None:
    page = b"\x15\x00\x15\x02\x15\x00\x2c\x15\x04\x00\x00"  # of 1 byte when unpacked, 0 in the file, 2 values
    count, read = 200_000, 0

    class Counted(io.BytesIO):
        def read(self, size: int | None = -1) -> bytes:
            nonlocal read
            found = super().read(size)
            read += len(found)
            return found

    assert list(read_pages(Counted(page * count), 0, len(page) * count)) == [Page(1, 2)] * count
    assert read < 1.2 * len(page) * count
