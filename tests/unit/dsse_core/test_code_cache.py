"""Compiled code is loaded only from where nobody but root and the user of this process can have put it."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("numba")

from dsse_core import code_cache, code_places, compiling
from dsse_core.code_places import find_fault, find_places
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


def test_a_link_is_evaluated_by_where_it_leads(place: Path, tmp_path: Path):
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
    assert beside == code_places.SOURCES / "__pycache__"
    assert of_user.parent == place / "dsse"


def faults_seen_by(user: int, folders: list[Path]) -> list[str | None]:
    """What ``find_fault`` tells an unprivileged process of ``user``."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(user)
            os.setuid(user)
            os.write(writer, json.dumps([find_fault(folder) for folder in folders]).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as file:
        reported = file.read()
    os.waitpid(child, 0)
    faults: list[str | None] = json.loads(reported)
    return faults


@pytest.mark.skipif(os.geteuid() != 0, reason="to become other users takes root")
def test_a_user_loads_code_of_his_own_and_of_root_and_of_nobody_else():
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        top = Path(name)
        top.chmod(0o755)
        places = {}
        for whose, owner in {"mine": STRANGER, "root's": 0, "another's": STRANGER + 1}.items():
            places[whose] = top / whose
            places[whose].mkdir(mode=0o755)
            os.chown(places[whose], owner, owner)
        for what, mode in {"of my group": 0o775, "of all": 0o757, "sticky": 0o1777}.items():
            places[what] = top / what
            places[what].mkdir()
            places[what].chmod(mode)
            os.chown(places[what], STRANGER, STRANGER)
        places["below another's"] = places["another's"] / "mine"
        places["below another's"].mkdir()
        os.chown(places["below another's"], STRANGER, STRANGER)
        places["a link to another's"] = places["mine"] / "link"
        places["a link to another's"].symlink_to(places["another's"])
        faults = dict(zip(places, faults_seen_by(STRANGER, list(places.values())), strict=True))
    assert (faults.pop("mine"), faults.pop("root's")) == (None, None)
    assert all(faults.values()), faults
    assert f"belongs to user {STRANGER + 1}" in (faults["below another's"] or "")
    assert f"belongs to user {STRANGER + 1}" in (faults["a link to another's"] or "")


def test_code_that_finds_no_room_is_not_reported_as_kept(place: Path, monkeypatch: pytest.MonkeyPatch):
    class Full:
        def save_overload(self, sig: object, data: object) -> None:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(code_cache, "find_folder_to_keep_in", lambda: place)
    monkeypatch.setattr(code_cache, "not_kept", [])
    kept = code_cache.KeptCode(find_fault)
    monkeypatch.setattr(kept, "_caches", {place: Full()})
    kept.save_overload("", None)
    assert [error.strerror for error in code_cache.not_kept] == ["No space left on device"]


def test_code_is_compiled_anew_when_a_source_in_any_room_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(code_places, "SOURCES", tmp_path)
    source = tmp_path / "radial" / "kernel.py"
    source.parent.mkdir()
    hashes = []
    for text in ("UPWARD = 1\n", "UPWARD = 2\n"):
        source.write_text(text)
        hashes.append(code_places.hash_of_sources.__wrapped__())
    assert hashes[0] != hashes[1]


@pytest.fixture
def kept_in(place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    found = (code_places.CodeFolder(place, None),)
    for module in (code_places, code_cache):
        monkeypatch.setattr(module, "find_places", lambda: found)
        monkeypatch.setattr(module, "find_folder_to_keep_in", lambda: place)
    monkeypatch.setattr(code_cache, "not_kept", [])
    return place


def test_a_command_that_answers_one_question_does_not_compile_and_the_next_one_may(kept_in: Path):
    assert compiling.find_obstacle() is None
    with compiling.only_loading():
        assert "`dsse compile` makes it" in (compiling.find_obstacle() or "")
    assert compiling.find_obstacle() is None
    with compiling.only_loading():
        code_cache.note_whole("estimate")
        assert compiling.find_obstacle() is None


def test_on_a_large_network_it_is_noted_for_afterwards_and_on_a_huge_one_compiled_at_once(kept_in: Path, monkeypatch):
    monkeypatch.setattr(compiling, "find_folder_to_keep_in", lambda: kept_in)
    with compiling.only_loading():
        assert compiling.find_obstacle(n_bus=compiling.FEWEST_BUSES_AFTERWARDS - 1)
        assert not compiling.has_done_without()
        assert "after this answer" in (compiling.find_obstacle(n_bus=compiling.FEWEST_BUSES_AFTERWARDS) or "")
        assert compiling.has_done_without()
        assert compiling.find_obstacle(n_bus=compiling.FEWEST_BUSES_AT_ONCE) is None
    assert compiling.take_done_without() == {"estimate"}
    assert not compiling.has_done_without()


def test_where_code_cannot_be_kept_nothing_is_compiled_afterwards(kept_in: Path, monkeypatch):
    monkeypatch.setattr(compiling, "find_folder_to_keep_in", lambda: None)
    with compiling.only_loading():
        assert "`dsse compile` makes it" in (compiling.find_obstacle(n_bus=100_000) or "")
    assert not compiling.has_done_without()


def test_code_of_another_processor_or_other_sources_is_not_taken_for_ready(
    kept_in: Path, monkeypatch: pytest.MonkeyPatch
):
    code_cache.note_whole("estimate")
    assert code_places.has_whole("estimate")
    for function, other in (("_name_processor", lambda: iter(["another"])), ("hash_of_sources", lambda: "others")):
        with monkeypatch.context() as patch:
            patch.setattr(code_places, function, other)
            code_places.name_of_note.cache_clear()
            assert not code_places.has_whole("estimate")
        code_places.name_of_note.cache_clear()


def test_code_that_could_not_be_kept_is_not_noted_as_ready(kept_in: Path):
    code_cache.not_kept.append(OSError(28, "No space left on device"))
    code_cache.note_whole("estimate")
    assert not code_places.has_whole("estimate")
