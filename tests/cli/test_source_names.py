"""The folders of several sources have names that tell them apart and are always the same."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.cli.map.summary import folder_names
from taichi_mrf.errors import ConfigError


def test_as_much_of_a_path_as_is_needed() -> None:
    assert folder_names(["scans/kitchen", "scans/hall/"]) == ["kitchen", "hall"]
    assert folder_names(["a/seq-01", "b/seq-01", "b/seq-02"]) == ["a_seq-01", "b_seq-01", "seq-02"]
    assert folder_names(["../a/depth", "/data/a/depth"]) == ["a_depth", "data_a_depth"]
    assert folder_names(["Hall", "x/hall"]) == ["Hall", "x_hall"]  # one folder on some file systems


def test_files_and_built_in_sequences() -> None:
    assert folder_names(["walk.bag?depth=/camera/depth", "run.bag"]) == ["walk", "run"]
    assert folder_names(["synthetic:room", "mesh:house.ply"]) == ["synthetic_room", "mesh_house"]
    assert folder_names(["synthetic:room?frames=3", "synthetic:room?frames=4"]) == [
        "synthetic_room_frames_3",
        "synthetic_room_frames_4",
    ]


def test_a_folder_keeps_the_dots_in_its_name(tmp_path: Path) -> None:
    (tmp_path / "2024.05.01").mkdir()
    assert folder_names([str(tmp_path / "2024.05.01")]) == ["2024.05.01"]
    assert folder_names([f"{tmp_path}/2024.05.01/.."]) == [tmp_path.name]


def test_a_source_that_is_named_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="kitchen: is named twice"):
        folder_names(["kitchen", "hall", "kitchen"])


@given(st.lists(st.text("aB/._?=: é\\", max_size=8), unique=True, max_size=8))
def test_names_are_different_harmless_and_repeatable(sources: list[str]) -> None:
    names = folder_names(sources)
    assert len({name.casefold() for name in names}) == len(sources)
    assert folder_names(sources) == names
    for name in names:
        assert Path(name).name == name
        assert not name.startswith(".")
