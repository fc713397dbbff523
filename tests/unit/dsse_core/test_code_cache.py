"""Compiled code is loaded only from where nobody but root and the user of this process can have put it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("numba")

from dsse_core import code_cache
from dsse_core.code_cache import find_fault, find_places
from dsse_core.errors import InvalidInputError

STRANGER = 54321


@pytest.fixture
def place(tmp_path: Path) -> Path:
    folder = tmp_path / "home" / "cache"
    folder.mkdir(parents=True, mode=0o755)
    (folder / "f-1.py311.nbi").write_bytes(b"")
    return folder


def give_to_a_stranger(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.geteuid() == 0:
        os.chown(path, STRANGER, -1)
    else:  # what is mine is then a stranger's
        monkeypatch.setattr(os, "geteuid", lambda: STRANGER)


def test_a_place_of_ones_own_has_no_fault(place: Path):
    assert find_fault(place) is None
    assert find_fault(place / "not" / "there" / "yet") is None


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o1777, 0o757])
def test_a_folder_that_others_can_write_is_not_loaded_from(place: Path, mode: int):
    place.chmod(mode)
    assert f"{place} can be written by others (mode {mode:o})" == find_fault(place)
    assert find_fault(place / "inside") == (None if mode == 0o1777 else find_fault(place))


def test_a_folder_below_one_that_others_can_write_is_not_loaded_from(place: Path):
    place.parent.chmod(0o777)  # they could put another folder in its place
    assert str(place.parent) in (find_fault(place) or "")
    place.parent.chmod(0o1777)  # as /tmp, where they cannot
    assert find_fault(place) is None


@pytest.mark.parametrize("whose", ["the folder", "the folder above", "a file"])
def test_what_belongs_to_a_stranger_is_not_loaded_from(place: Path, monkeypatch: pytest.MonkeyPatch, whose: str):
    strange = {"the folder": place, "the folder above": place.parent, "a file": place / "f-1.py311.nbi"}[whose]
    give_to_a_stranger(strange, monkeypatch)
    assert "belongs to user" in (find_fault(place) or "")


def test_code_that_others_can_write_is_not_loaded(place: Path):
    (place / "f-1.py311.nbi").chmod(0o666)
    assert "can be written by others" in (find_fault(place) or "")


def test_a_link_to_code_elsewhere_is_not_followed(place: Path, tmp_path: Path):
    (tmp_path / "code").write_bytes(b"")
    (place / "f-1.py311.1.nbc").symlink_to(tmp_path / "code")
    assert "neither folder nor file" in (find_fault(place) or "")


def test_a_link_is_judged_by_where_it_leads(place: Path, tmp_path: Path):
    (tmp_path / "link").symlink_to(place)
    assert find_fault(tmp_path / "link") is None
    place.chmod(0o777)
    assert find_fault(tmp_path / "link") == find_fault(place)


def test_a_folder_that_the_user_has_chosen_and_others_can_write_is_an_error(
    place: Path, monkeypatch: pytest.MonkeyPatch
):
    place.chmod(0o777)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(place))
    with pytest.raises(InvalidInputError, match=r"NUMBA_CACHE_DIR.*\n.*can be written by others.*; make it writable"):
        find_places.__wrapped__()


def test_without_a_choice_an_administrators_place_comes_before_the_users(monkeypatch: pytest.MonkeyPatch, place: Path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(place))
    beside, of_user = (found.folder for found in find_places.__wrapped__())
    assert beside == code_cache.SOURCES / "__pycache__"
    assert of_user.parent == place / "dsse"
