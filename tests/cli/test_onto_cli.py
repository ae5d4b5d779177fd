"""``taichi-mrf map --onto``: today's recording located in yesterday's map, or refused in one line."""

import json
from pathlib import Path

import pytest
from console import FAST, as_process, assert_refused, taichi_mrf
from two_days import TODAY as TODAY_FRAMES
from two_days import recorded, turned_away

import taichi_mrf as tm
from taichi_mrf.session.files import MAP_FILE, REPORT_FILE

pytestmark = pytest.mark.usefixtures("one_backend")

YESTERDAY = "synthetic:room?frames=24&width=160&height=120"
TODAY = "synthetic:room?frames=20&width=160&height=120&seed=3"


@pytest.fixture(scope="module")
def yesterday(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("yesterday")
    done = taichi_mrf("map", YESTERDAY, "--out", folder, *FAST)
    assert done.returncode == 0, done.stderr
    return folder / MAP_FILE


def test_today_goes_on_in_the_map_of_yesterday(yesterday: Path, tmp_path: Path) -> None:
    before = yesterday.read_bytes()
    done = as_process("map", TODAY, "--onto", yesterday, "--out", tmp_path, "--no-pictures")
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert "18 of them keyframes, which join 22 of the earlier map" in said
    assert "% of what is seen agrees" in said
    report = json.loads((tmp_path / REPORT_FILE).read_text())
    assert (report["keyframes"], report["keyframes_before"]) == (40, 22)
    assert report["onto"] == str(yesterday)
    assert report["located"]["agreement"] > 0.9
    assert report["voxel_size"] == 0.1
    assert report["accuracy"]["frames"] == 2
    assert len(tm.load_map(tmp_path / MAP_FILE).keyframes) == 40
    assert yesterday.read_bytes() == before
    # The folder holds this very run; one of another map is another run.
    again = taichi_mrf("map", TODAY, "--onto", yesterday, "--out", tmp_path, "--no-pictures")
    assert again.returncode == 0
    assert "already holds this run" in again.stdout
    assert_refused(taichi_mrf("map", TODAY, "--out", tmp_path, *FAST), "holds a run with another")


def test_frozen_keyframes_of_yesterday_are_evidence(yesterday: Path, tmp_path: Path) -> None:
    done = taichi_mrf("map", TODAY, "--onto", yesterday, "--frozen", "--out", tmp_path, "--no-pictures")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / REPORT_FILE).read_text())
    assert (report["keyframes"], report["frozen"], report["keyframes_before"]) == (18, 22, 22)


def test_another_place_is_refused_and_nothing_is_written(yesterday: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = taichi_mrf(
        "map", "synthetic:corridor?frames=12&width=160&height=120", "--onto", yesterday, "--out", out
    )
    assert_refused(done, f"not found in {yesterday}: ")
    assert not (out / MAP_FILE).exists()


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (("--voxel-size", "0.02"), "made with another voxel_size"),
        (("--refine-poses",), "--refine-poses moves keyframes"),
        (("--noise", "auto"), "--noise auto does not work with --onto"),
        (("--submap-size", "5"), "does not work with --submap-size"),
    ],
)
def test_flags_that_do_not_go_with_it(
    yesterday: Path, tmp_path: Path, flags: tuple[str, ...], says: str
) -> None:
    assert_refused(taichi_mrf("map", TODAY, "--onto", yesterday, "--out", tmp_path / "out", *flags), says)


def test_frozen_needs_a_map_and_the_map_has_to_be_one(tmp_path: Path) -> None:
    assert_refused(taichi_mrf("map", TODAY, "--frozen", "--out", tmp_path / "out"), "add --onto MAP")
    done = taichi_mrf("map", TODAY, "--onto", tmp_path / "none.npz", "--out", tmp_path / "out")
    assert_refused(done, "none.npz")
    done = taichi_mrf("map", TODAY, "--onto", tmp_path / "none.zarr", "--out", tmp_path / "out")
    assert_refused(done, "none.zarr: there is no such folder")


def test_a_map_in_chunks_is_gone_on_with_and_merged_into(yesterday: Path, tmp_path: Path) -> None:
    chunks, today, both = tmp_path / "map.zarr", tmp_path / "today", tmp_path / "both.npz"
    assert taichi_mrf("export", yesterday, "--to", chunks).returncode == 0
    done = taichi_mrf("map", TODAY, "--onto", chunks, "--out", today, "--no-pictures")
    assert done.returncode == 0, done.stderr
    report = json.loads((today / REPORT_FILE).read_text())
    assert (report["keyframes"], report["frozen"], report["keyframes_before"]) == (18, 1, 1)
    assert report["located"]["agreement"] > 0.8
    done = taichi_mrf("map", TODAY, "--out", tmp_path / "alone", *FAST)
    merged = taichi_mrf("merge", chunks, tmp_path / "alone" / MAP_FILE, "--out", both)
    assert merged.returncode == 0, merged.stderr
    m = tm.load_map(both)
    assert (len(m.keyframes), dict(m.frozen)) == (18, {0: "map.zarr"})
    # The other way around, and two maps of voxels, the evidence of chunks is moved.
    assert (
        taichi_mrf("export", tmp_path / "alone" / MAP_FILE, "--to", tmp_path / "alone.zarr").returncode == 0
    )
    for maps, frozen in (
        ((tmp_path / "alone" / MAP_FILE, chunks), 1),
        ((chunks, tmp_path / "alone.zarr"), 2),
    ):
        merged = taichi_mrf("merge", *maps, "--out", both)
        assert merged.returncode == 0, merged.stderr
        assert "% of what is seen agrees" in " ".join(merged.stdout.split())
        m = tm.load_map(both)
        assert (len(m.keyframes), len(m.frozen)) == (18 * (frozen == 1), frozen)


def test_merge_writes_one_map_of_two(yesterday: Path, tmp_path: Path) -> None:
    done = taichi_mrf("map", TODAY, "--out", tmp_path / "today", *FAST)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "both.npz"
    done = as_process("merge", yesterday, tmp_path / "today" / MAP_FILE, "--out", out)
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert "% of what is seen agrees" in said
    assert "40 keyframes, " in said
    assert len(tm.load_map(out).keyframes) == 40
    again = taichi_mrf("merge", yesterday, tmp_path / "today" / MAP_FILE, "--out", out, "--json")
    facts = json.loads(again.stdout)
    assert facts["keyframes"] == 40
    assert facts["loops"] > 5
    assert_refused(taichi_mrf("merge", yesterday, "--out", out), "two maps or more")
    assert_refused(taichi_mrf("merge", yesterday, yesterday, "--out", tmp_path / "out.ply"), ".npz")


def test_diff_of_a_map_and_one_of_the_next_day(yesterday: Path, tmp_path: Path) -> None:
    """A map of a recording whose world is another is laid over the first."""
    today = tm.MRFMap.from_config(tm.load_map(yesterday).config, recorded(TODAY_FRAMES).camera)
    for frame in recorded(TODAY_FRAMES, turned_away()):
        today.add(frame)
    today.infer()
    today.save(tmp_path / "today.npz")
    done = taichi_mrf("diff", yesterday, tmp_path / "today.npz", "--json")
    facts = json.loads(done.stdout)
    assert facts["located"]["says"].endswith("% of what is seen agrees")
    assert facts["known_in_both"] > 0.6 * (facts["only_in_a"] + facts["only_in_b"] + facts["known_in_both"])
    assert facts["volume_in_both_m3"] == pytest.approx(facts["known_in_both"] * 0.1**3)
    said = taichi_mrf("diff", yesterday, tmp_path / "today.npz").stdout
    assert "B located in A: " in said
    # The same world: compared as it stands, in words as before.
    assert "located" not in taichi_mrf("diff", yesterday, yesterday).stdout
