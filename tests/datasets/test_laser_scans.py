"""CARMEN logs and npz files of scans: what is written is read, and what is broken is named."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from laser_logs import ODOMETRY, flaser, robotlaser, write_npz
from refusals import refusal

from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.errors import DatasetError

# No subnormal numbers: Taichi, once started, rounds them to 0 in all of the process.
RANGE = st.floats(0.0, 100.0, width=32, allow_subnormal=False)
COORDINATE = st.floats(-1e3, 1e3, allow_subnormal=False)
ANGLE = st.floats(-math.pi, math.pi, allow_subnormal=False)
POSE = st.tuples(COORDINATE, COORDINATE, ANGLE)


@st.composite
def logged_scans(draw: st.DrawFn) -> list[tuple[list[float], tuple[float, float, float]]]:
    beams = draw(st.integers(1, 8))
    return draw(
        st.lists(st.tuples(st.lists(RANGE, min_size=beams, max_size=beams), POSE), min_size=1, max_size=5)
    )


@given(scans=logged_scans(), packed=st.booleans(), rear=st.booleans())
def test_a_log_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    scans: list[tuple[list[float], tuple[float, float, float]]],
    packed: bool,
    rear: bool,
) -> None:
    path = tmp_path_factory.mktemp("log") / ("small.log.gz" if packed else "small.log")
    lines = ["# a comment", "PARAM robot_width 0.5"]
    for number, (ranges, pose) in enumerate(scans):
        lines += [ODOMETRY, flaser(ranges, pose, "RLASER" if rear and number % 2 else "FLASER"), "NEFF 3.2"]
    text = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(text) if packed else text)
    read = open_scans(path)
    assert read.name == "small"
    assert read.range_m.tolist() == [ranges for ranges, _ in scans]
    assert read.pose_x_y_theta.tolist() == [list(pose) for _, pose in scans]
    assert read.hit.tolist() == [[r < 49.5 for r in ranges] for ranges, _ in scans]
    assert not read.no_return_is_free
    (note,) = read.notes
    assert note.startswith("no return: ranges of 49.50 m and more")


@pytest.mark.parametrize(
    ("beams", "first_degrees", "step_degrees", "last_degrees"),
    [(180, -90, 1, 89), (181, -90, 1, 90), (360, -90, 0.5, 89.5), (361, -90, 0.5, 90), (4, -90, 45, 45)],
)
def test_beams_cover_half_a_turn(
    tmp_path: Path, beams: int, first_degrees: float, step_degrees: float, last_degrees: float
) -> None:
    path = tmp_path / "a.log"
    path.write_text(flaser([1.0] * beams, (0, 0, 0)))
    angles = np.degrees(open_scans(path).angle_rad)
    assert angles[[0, -1]] == pytest.approx([first_degrees, last_degrees])
    assert np.diff(angles) == pytest.approx(step_degrees)


@given(
    ranges=st.lists(RANGE, min_size=1, max_size=6),
    pose=POSE,
    start=ANGLE,
    step=st.floats(1e-3, 0.1),
    max_range=st.floats(1.0, 90.0),
    remissions=st.lists(st.integers(0, 99), max_size=3),
)
def test_the_newer_line_says_where_its_beams_go(
    tmp_path_factory: pytest.TempPathFactory,
    ranges: list[float],
    pose: tuple[float, float, float],
    start: float,
    step: float,
    max_range: float,
    remissions: list[int],
) -> None:
    path = tmp_path_factory.mktemp("log") / "new.clf"
    path.write_text(robotlaser(ranges, pose, start, step, max_range, remissions) + "\n")
    read = open_scans(path)
    assert read.range_m.tolist() == [ranges]
    assert read.pose_x_y_theta.tolist() == [list(pose)]
    assert read.angle_rad == pytest.approx(start + step * np.arange(len(ranges)))
    limit = np.float32(min(max_range, 49.5))
    assert read.hit.tolist() == [[bool(np.float32(r) < limit) for r in ranges]]


def corridor_log(path: Path, nothing_m: float, scans: int = 60) -> Path:
    """A robot that drives along a corridor: walls at the sides, nothing straight ahead."""
    lines = []
    for scan in range(scans):
        side = 2.0 + 0.01 * (scan % 7)
        ahead = [min(30.0, 25.0 - 0.1 * scan) if scan % 2 else nothing_m, nothing_m]
        lines.append(flaser([side, 2 * side, *ahead, 2.1 * side, side], (0.1 * scan, 0.0, 0.0)))
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize("nothing_m", [8.0, 32.77, 50.0, 81.83])
def test_the_range_that_means_no_return_is_found(tmp_path: Path, nothing_m: float) -> None:
    read = open_scans(corridor_log(tmp_path / "walk.log", nothing_m))
    if nothing_m < 25:  # real surfaces lie beyond: the peak is not at the end of what is measured
        assert "49.50 m and more" in read.notes[0]
        return
    assert (read.range_m[~read.hit] == np.float32(nothing_m)).all()
    assert (~read.hit).sum() == (read.range_m == np.float32(nothing_m)).sum() == 90
    assert "25.00% of the beams (found in the log" in read.notes[0]


def test_the_range_that_means_no_return_can_be_given(tmp_path: Path) -> None:
    path = corridor_log(tmp_path / "walk.log", 8.0)
    read = open_scans(path, no_return_m=8.0)
    assert read.hit.tolist() == (read.range_m < 8).tolist()
    assert read.notes[0].startswith("no return: ranges of 8.00 m and more")
    assert read.notes[0].endswith("(set by --no-return-range)")


def test_a_robot_that_stands_before_a_wall_measures_the_wall(tmp_path: Path) -> None:
    path = tmp_path / "still.log"
    path.write_text("\n".join([flaser([2.0, 30.0, 30.0, 2.0], (0, 0, 0))] * 100))
    assert open_scans(path).hit.all()


def test_an_npz_file_without_hits_is_doubted(tmp_path: Path) -> None:
    log = open_scans(corridor_log(tmp_path / "walk.log", 32.77))
    changes = {
        "range_m": log.range_m,
        "angle_rad": log.angle_rad,
        "pose_x_y_theta": log.pose_x_y_theta,
        "hit": np.ones_like(log.hit),
    }
    path = write_npz(tmp_path / "scans.npz", **changes)
    assert "25.00% of the beams have ranges of 32.6" in open_scans(path).notes[0]
    np.testing.assert_array_equal(open_scans(path, no_return_m=32.0).hit, log.hit)


GOOD = flaser([1.0, 2.0, 3.0], (0.5, 0.25, 0.125))

BROKEN_LINES = {
    "nan": (flaser([1.0, math.nan, 3.0], (0, 0, 0)), "beam 2 is nan"),
    "infinite": (flaser([math.inf, 2.0, 3.0], (0, 0, 0)), "beam 1 is inf"),
    "negative": (flaser([1.0, 2.0, -0.5], (0, 0, 0)), "beam 3 is -0.5"),
    "pose not finite": (flaser([1.0, 2.0, 3.0], (0, math.nan, 0)), "pose"),
    "cut in the ranges": ("FLASER 3 1.0 2.0", "ends after 2"),
    "no pose": ("FLASER 3 1.0 2.0 3.0", "no pose"),
    "half a pose": ("FLASER 3 1.0 2.0 3.0 0.5 0.5", "no pose"),
    "nothing but the name": ("FLASER", "ends before the number"),
    "no count": ("FLASER three 1.0 2.0 3.0 0 0 0", "'three'"),
    "negative count": ("FLASER -3 1.0 2.0 3.0 0 0 0", "'-3'"),
    "no beams": ("FLASER 0 0 0 0", "'0'"),
    "a word among the ranges": ("FLASER 3 1.0 two 3.0 0 0 0", "'two'"),
    "a word in the pose": ("FLASER 3 1.0 2.0 3.0 x 0 0", "'x'"),
    "other number of beams": (flaser([1.0, 2.0], (0, 0, 0)), "2 beams"),
    "other angles": (robotlaser([1.0, 2.0, 3.0], (0, 0, 0), 0.0, 0.1, 8.0), "angles"),
    "cut in the header": ("ROBOTLASER1 0 -1.5 3.1", "describe the scanner"),
    "cut in the remissions": ("ROBOTLASER1 0 -1.5 3.0 1.0 8.0 0.01 0 3 1 2 3 2 7", "no pose"),
    "no greatest range": (robotlaser([1.0, 2.0, 3.0], (0, 0, 0), 0.0, 0.1, 0.0), "greatest range"),
}


@pytest.mark.parametrize("name", BROKEN_LINES)
def test_a_broken_line_is_named_or_left_out(tmp_path: Path, name: str) -> None:
    line, words = BROKEN_LINES[name]
    path = tmp_path / "broken.log"
    path.write_text("\n".join([ODOMETRY, GOOD, line, GOOD]))
    with refusal(DatasetError, f"{path}: line 3: ", words) as refused:
        open_scans(path)
    read = open_scans(path, skip_bad_scans=True)
    assert len(read) == 2
    assert read.notes[0].startswith("1 broken scans were left out")
    assert str(refused.value) in read.notes[0]


@pytest.mark.parametrize("text", ["", ODOMETRY, "FLASERS 3 1 2 3 0 0 0", "\x00\xff\x00"])
def test_a_log_without_scans_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "empty.log"
    path.write_bytes(text.encode("latin-1"))
    for skip in (False, True):
        with pytest.raises(DatasetError, match=r"empty\.log: contains no scans"):
            open_scans(path, skip_bad_scans=skip)


def test_when_every_scan_is_broken_the_first_is_named(tmp_path: Path) -> None:
    path = tmp_path / "broken.log"
    path.write_text("FLASER 3 1.0\nFLASER 2 1.0\n")
    with pytest.raises(DatasetError, match="line 1"):
        open_scans(path, skip_bad_scans=True)


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_a_truncated_gzip_log_is_named_or_read_as_far_as_it_goes(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "cut.log.gz"
    random = np.random.default_rng(0)
    text = "\n".join(flaser(random.uniform(0, 9, 90), (0, 0, 0)) for _ in range(60))
    packed = gzip.compress(text.encode())
    path.write_bytes(packed[: int(kept * len(packed))])
    with refusal(DatasetError, "cut.log.gz", "truncated"):
        open_scans(path)
    read = open_scans(path, skip_bad_scans=True)
    assert 0 < len(read) < 60
    assert "truncated" in read.notes[0]


@given(
    scans=st.integers(1, 5),
    beams=st.integers(1, 6),
    seed=st.integers(0, 99),
)
def test_an_npz_file_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, scans: int, beams: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    arrays = {
        "range_m": random.uniform(0, 9, (scans, beams)).astype(np.float32),
        "angle_rad": random.uniform(-3, 3, beams),
        "pose_x_y_theta": random.normal(size=(scans, 3)),
        "hit": random.integers(0, 2, (scans, beams)).astype(np.uint8),
    }
    folder = tmp_path_factory.mktemp("hall")
    np.savez_compressed(folder / "scans.npz", **arrays)
    for source in (folder, folder / "scans.npz"):
        read = open_scans(source)
        assert read.name == folder.name
        assert np.array_equal(read.range_m, arrays["range_m"])
        assert np.array_equal(read.angle_rad, arrays["angle_rad"])
        assert np.array_equal(read.pose_x_y_theta, arrays["pose_x_y_theta"])
        assert np.array_equal(read.hit, arrays["hit"] != 0)
        assert read.no_return_is_free


BROKEN_ARRAYS = {
    "no ranges": ({"range_m": None}, "no array 'range_m'"),
    "no angles": ({"angle_rad": None}, "no array 'angle_rad'"),
    "no poses": ({"pose_x_y_theta": None}, "no array 'pose_x_y_theta'"),
    "no returns": ({"hit": None}, "no array 'hit'"),
    "flat ranges": ({"range_m": np.ones(3)}, "(scans, beams)"),
    "beams without angles": ({"angle_rad": np.zeros(2)}, "angle_rad has the shape (2,)"),
    "scans without poses": ({"pose_x_y_theta": np.zeros((1, 3))}, "pose_x_y_theta has the shape (1, 3)"),
    "beams without returns": ({"hit": np.ones((2, 2))}, "hit has the shape (2, 2)"),
    "words": ({"angle_rad": np.array(["a", "b", "c"])}, "not numbers"),
    "angle not finite": ({"angle_rad": np.array([0, np.nan, 1])}, "angle_rad"),
    "zero scans": (
        {"range_m": np.zeros((0, 3)), "pose_x_y_theta": np.zeros((0, 3)), "hit": np.zeros((0, 3))},
        "contains no scans",
    ),
    "zero beams": ({"range_m": np.zeros((2, 0))}, "(scans, beams)"),
    "objects": ({"range_m": np.array([[{}]], dtype=object)}, "range_m cannot be read"),
}


@pytest.mark.parametrize("name", BROKEN_ARRAYS)
def test_a_broken_npz_file_is_named(tmp_path: Path, name: str) -> None:
    changes, words = BROKEN_ARRAYS[name]
    path = write_npz(tmp_path / "broken.npz", **changes)
    with refusal(DatasetError, str(path), words):
        open_scans(path, skip_bad_scans=True)


@pytest.mark.parametrize(
    ("value", "word"), [(np.nan, "nan"), (np.inf, "inf"), (-1.0, "-1")], ids=["nan", "infinite", "negative"]
)
def test_a_broken_range_in_an_npz_file_is_named_or_its_scan_left_out(
    tmp_path: Path, value: float, word: str
) -> None:
    range_m = np.ones((2, 3), dtype=np.float32)
    range_m[1, 2] = value
    path = write_npz(tmp_path / "broken.npz", range_m=range_m)
    with pytest.raises(DatasetError, match=rf"scan 2 of 2: the range of beam 3 is {word}"):
        open_scans(path)
    read = open_scans(path, skip_bad_scans=True)
    assert read.range_m.tolist() == [[1.0, 1.0, 1.0]]
    assert "1 broken scans" in read.notes[0]


@pytest.mark.parametrize("kept", [1, 40, 200])
def test_a_truncated_npz_file_is_named(tmp_path: Path, kept: int) -> None:
    path = write_npz(tmp_path / "cut.npz")
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DatasetError, match=r"cut\.npz: not a whole npz file"):
        open_scans(path)


def test_sources_that_do_not_exist_are_named(tmp_path: Path) -> None:
    for source, said in (
        (tmp_path / "nowhere.log", "nowhere.log: no such file"),
        (tmp_path, "contains no scans.npz"),
        ("synthetic:castle", "synthetic:floor-plan"),
    ):
        with refusal(DatasetError, said):
            open_scans(source)


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("place", "scans", "beams"),
    [
        ("cave_player", 768, 361),
        ("hospital_section_player/scans.npz", 775, 361),
        ("carmen/intel-corrected.log.gz", 910, 180),
        ("carmen/freiburg-079-corrected.log.gz", 4791, 360),
    ],
)
def test_the_real_recordings_are_read(shared_data: Path, place: str, scans: int, beams: int) -> None:
    read = open_scans(shared_data / "laser2d" / place)
    assert read.range_m.shape == (scans, beams)
    assert read.angle_rad[0] == pytest.approx(-math.pi / 2)
    assert 0.9 < read.hit.mean() < 1
    assert read.range_m[read.hit].max() < 49.5
    assert [note.startswith("no return: ranges of 81.") for note in read.notes] == [True] * (
        "carmen" in place
    )


def test_a_packed_log_may_unpack_to_what_its_size_lets_expect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each line is short, and there is no end of them."""
    path = tmp_path / "endless.log.gz"
    path.write_bytes(gzip.compress(b"FLASER 2 1 1 0 0 0\n" * 100_000))
    monkeypatch.setattr("taichi_mrf.system.packed.LEAST_BYTES", 1_000_000)
    with pytest.raises(DatasetError, match=r"endless\.log\.gz line \d+: the log unpacks to .* too much"):
        open_scans(path, skip_bad_scans=True)
    path.write_bytes(gzip.decompress(path.read_bytes())[:1900])
    assert len(open_scans(path).range_m) == 100


MANY = "9" * 5000
"""More digits than Python makes a number of (sys.get_int_max_str_digits)."""


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (f"FLASER {MANY} 1 1 0 0 0 0 0 0 1 host 1", rf"'{'9' * 40}' as the number of its ranges"),
        (f"FLASER 2 1 {MANY} 0 0 0 0 0 0 1 host 1", "the range of beam 2 is inf"),
        (f"FLASER 2 1 1 {MANY} 0 0 0 0 0 1 host 1", "pose contains a value that is not finite"),
        (f"ROBOTLASER1 0 -1.5 3.1 {MANY} 9 0.1 0 2 1 1 0 0 0 0", "greatest range is not a usable number"),
        (
            f"ROBOTLASER1 0 -1.5 3.1 1.5 9 0.1 0 2 1 1 {MANY} 0 0 0",
            rf"'{'9' * 40}' as the number of its remi",
        ),
    ],
)
def test_a_number_of_thousands_of_digits_spoils_its_scan_alone(
    line: str, problem: str, tmp_path: Path
) -> None:
    path = tmp_path / "digits.log"
    path.write_text(
        "\n".join([flaser([1.0, 2.0], (0.0, 0.0, 0.0)), line, flaser([3.0, 4.0], (1.0, 0.0, 0.0))])
    )
    with pytest.raises(DatasetError, match=problem) as caught:
        open_scans(path)
    assert "line 2" in str(caught.value)
    assert len(str(caught.value)) < 500
    assert open_scans(path, skip_bad_scans=True).range_m.tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize("begin", [b"", b"FLASER 180 ", b"ROBOTLASER1 0 "])
def test_a_line_of_a_hundred_million_characters_is_named(begin: bytes, tmp_path: Path) -> None:
    path = tmp_path / "long.log"
    with path.open("wb") as file:
        file.write(b"# a comment\n" + begin)
        file.truncate(100_000_000)
    with pytest.raises(DatasetError, match=r"long\.log line 2: longer than 10,000,000 bytes"):
        open_scans(path, skip_bad_scans=True)
