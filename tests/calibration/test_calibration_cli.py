"""``taichi-mrf calibrate`` as a person runs it: a process, its files, its words, its exit status."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_boards import BOARD_FLAGS, CAMERA_TEXT, captured, write_recording
from calibration_scenes import CAMERA, Planes, Tables, random_tables
from console import assert_refused, complaints, report_of, taichi_mrf
from datasets_recordings import write_stamped
from numpy.polynomial.polynomial import polyval

from taichi_mrf.cli.main import main
from taichi_mrf.config import schema as config
from taichi_mrf.config.schema import load
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.no_return import no_return_chance
from taichi_mrf.sensor.noise import PatchNoise, noise_from_config
from taichi_mrf.system.compiler import COMPILERS

NOISE_FILES = {"sigma.npy", "bias.npy", "noise.npz", "sensor.yaml", "report.json"}
PICTURES = {"noise_curves.png", "noise_maps.png", "coverage.png"}
LAG = 0.137
BOARD_PATCH = 80
BOARD_OPTIONS = (
    *BOARD_FLAGS, "--patch", str(BOARD_PATCH), "--max-depth", "3", "--least-count", "500", "--no-pictures",
)  # fmt: skip
"""With fewer than some hundred samples a bin, chance alone would move bias by a millimetre."""


def calibrated(*arguments: str | Path) -> str:
    """Run ``calibrate``, which must succeed without complaints; returns what it printed."""
    done = taichi_mrf("calibrate", *arguments)
    assert done.returncode == 0, done.stderr
    assert complaints(done.stderr) == ""
    return done.stdout


def assert_learnt(out: Path, tables: Tables, patch: int) -> None:
    """Bias and sigma within 5% or 1 mm of the known ones wherever a patch has samples of its own."""
    options, noise = report_of(out)["options"], np.load(out / "noise.npz")
    assert options["patch"] == patch
    middle = 0.5 * (noise["depth_edges"][:-1] + noise["depth_edges"][1:])
    checked = (noise["counts"] >= options["least_count"]) & noise["own"][:, None]
    assert checked.sum() > 50
    for name in ("bias", "sigma"):
        learnt, truth = polyval(middle, noise[name].T), polyval(middle, getattr(tables, name).T)
        off = np.abs(learnt - truth) / np.maximum(0.05 * np.abs(truth), 1e-3)
        assert off[checked].max() <= 1


@pytest.fixture(scope="module")
def tables() -> Tables:
    return random_tables(48, 20, np.random.default_rng(1))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, tables: Tables) -> Path:
    """Planes before a camera of 160 x 120 pixels: ``depth/`` as PNG in 1/5000 m, ``true.npz`` in metres."""
    folder = tmp_path_factory.mktemp("planes")
    (folder / "depth").mkdir()
    source = Planes(tables, 100, 0.6, 3.5)
    stack = []
    for name in source.names:
        pair = source.read(name)
        steps = np.clip(np.rint(5000 * pair.measured_m), 0, 65535).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{name}.png"), steps)
        stack.append(pair.true_m)
    np.savez(folder / "true.npz", depth_m=np.stack(stack), T_world_camera=np.eye(4))
    return folder


@pytest.fixture(scope="module")
def planes_run(recording: Path) -> tuple[Path, str]:
    out = recording / "out"
    said = calibrated(
        recording / "depth", "--true-depth", recording / "true.npz", "--depth-scale", "5000", "--out", out
    )
    return out, said


@pytest.fixture(scope="module")
def board_tables() -> Tables:
    """A precise sensor: 90 images of a board are few, and must tell its noise to 5% or a millimetre."""
    tables = random_tables(12, BOARD_PATCH, np.random.default_rng(4))
    return dataclasses.replace(tables, sigma=0.5 * tables.sigma)


@pytest.fixture(scope="module")
def board_recording(tmp_path_factory: pytest.TempPathFactory, board_tables: Tables) -> Path:
    """A moving board: depth, infrared images, stamps, and motion capture that is LAG later."""
    folder = tmp_path_factory.mktemp("board") / "recording"
    write_recording(folder, np.arange(90) / 10.3, board_tables)
    capture = captured(LAG, 9.0, np.random.default_rng(5), noise=5e-5)
    write_stamped(folder / "camera_poses.txt", capture.camera.stamps, capture.camera.poses)
    write_stamped(folder / "board_poses.txt", capture.board.stamps, capture.board.poses)
    return folder


def test_true_depth_gives_tables_and_a_report(planes_run: tuple[Path, str], tables: Tables) -> None:
    out, said = planes_run
    assert {path.name for path in out.iterdir()} == NOISE_FILES | PICTURES
    assert_learnt(out, tables, patch=20)
    report = report_of(out)
    assert 0.9 * 100 * 160 * 120 < report["samples"] <= 100 * 160 * 120
    assert report["patches"] == 48
    assert report["ground_truth"]["kind"] == "true depth"
    for words in ("Not covered in the whole image", "assumed the camera of a PrimeSense camera", "misfit"):
        assert words in said
    for name in NOISE_FILES | PICTURES:
        assert str(out / name) in said.replace("\n", "")


def test_the_chance_of_no_return_is_learnt_too(recording: Path, tmp_path: Path) -> None:
    true, rng = np.load(recording / "true.npz")["depth_m"], np.random.default_rng(3)
    (tmp_path / "depth").mkdir()
    for number, path in enumerate(sorted((recording / "depth").glob("*.png"))):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        image[rng.random(image.shape) < no_return_chance(true[number], 0.1, 2.5, 0.3)] = 0
        cv2.imwrite(str(tmp_path / "depth" / path.name), image)
    arguments = (tmp_path / "depth", "--depth-scale", "5000", "--out", tmp_path / "out", "--no-returns")
    said = calibrated(*arguments, "--no-pictures", "--true-depth", recording / "true.npz")
    sensor = load(tmp_path / "out" / "sensor.yaml").sensor
    assert sensor.no_return == "model"
    assert sensor.no_return_share == pytest.approx(0.1, abs=0.01)
    assert sensor.no_return_depth == pytest.approx(2.5, abs=0.05)
    assert sensor.no_return_width == pytest.approx(0.3, abs=0.03)
    assert report_of(tmp_path / "out")["no_return_depth"] == sensor.no_return_depth
    assert "no return" in said
    assert_refused(
        taichi_mrf("calibrate", *arguments, "--images", tmp_path), "--no-returns needs --true-depth"
    )


def test_the_map_takes_what_was_learnt(planes_run: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = planes_run
    sensor = load(out / "sensor.yaml").sensor
    by_yaml = noise_from_config(sensor, CAMERA).table(CAMERA)
    by_npz = PatchNoise.load(out / "noise.npz").table(CAMERA)
    np.testing.assert_array_equal(by_yaml.coefficients, by_npz.coefficients)
    assert (by_yaml.patch, sensor.min_depth, sensor.max_depth) == (20, 0.3, 5.0)
    done = taichi_mrf(
        "map", "synthetic:room?frames=3&width=160&height=120", "--out", tmp_path / "map",
        "--config", out / "sensor.yaml", "--voxel-size", "0.1", "--runtime.arch", "cpu", "--no-pictures",
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    used = config.load(tmp_path / "map" / "config.yaml").sensor
    assert used.sigma_table == str((out / "sigma.npy").resolve())


@pytest.mark.usefixtures("one_backend")
def test_a_chessboard_gives_the_true_depth(
    board_recording: Path, board_tables: Tables, tmp_path: Path
) -> None:
    said = calibrated(
        board_recording / "depth", "--images", board_recording / "ir", "--out", tmp_path, *BOARD_OPTIONS
    )
    truth = report_of(tmp_path)["ground_truth"]
    assert truth["kind"] == "chessboard"
    assert truth["boards_found"] > 80
    assert truth["median_reprojection_px"] < 0.2
    assert f"{truth['boards_found']} of 90 images" in said
    assert_learnt(tmp_path, board_tables, BOARD_PATCH)


def test_motion_capture_gives_the_true_depth_and_the_lag(
    board_recording: Path, board_tables: Tables, tmp_path: Path
) -> None:
    said = calibrated(
        board_recording / "depth", "--images", board_recording / "ir", "--out", tmp_path, *BOARD_OPTIONS,
        "--camera-poses", board_recording / "camera_poses.txt",
        "--board-poses", board_recording / "board_poses.txt",
        "--stamps", board_recording / "stamps.txt",
    )  # fmt: skip
    truth = report_of(tmp_path)["ground_truth"]
    assert truth["kind"] == "motion capture"
    assert truth["lag_s"] == pytest.approx(LAG, abs=max(4 * truth["lag_standard_error_s"], 1e-3))
    assert truth["lag_standard_error_s"] < 1e-3
    assert "ms after the images" in said
    assert report_of(tmp_path)["images"] == 90
    assert_learnt(tmp_path, board_tables, BOARD_PATCH)


def test_the_help_shows_every_parameter() -> None:
    done = taichi_mrf("calibrate", "--help")
    assert done.returncode == 0
    for flag in ("--true-depth", "--images", "--camera-poses", "--patch", "--board.columns", "--degree"):
        assert flag in done.stdout
    assert "Inner corners along a row of the chessboard" in done.stdout


def test_help_loads_no_heavy_library() -> None:
    done = taichi_mrf("calibrate", "--help", options=("-X", "importtime"))
    imported = {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    assert "taichi_mrf.cli.options.calibrate" in imported
    assert not imported & {*COMPILERS, "matplotlib", "cv2", "numpy"}


def write_depth(folder: Path, shape: tuple[int, int], value: float = 1.0, names: str = "abc") -> Path:
    """A folder of even depth images."""
    folder.mkdir()
    for name in names:
        np.save(folder / f"{name}.npy", np.full(shape, value, np.float32))
    return folder


Refused = Callable[..., str]


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run ``calibrate`` in this process, to which it must say one line and leave nothing behind."""

    def run(*arguments: str | Path) -> str:
        out = tmp_path / "out"
        assert main(["calibrate", *map(str, arguments), "--out", str(out)]) == 2
        said = capsys.readouterr()
        assert (said.out, said.err.count("\n")) == ("", 1)
        assert said.err.startswith("taichi-mrf: ")
        assert not out.exists()
        return said.err

    return run


def test_a_refusal_is_one_line_and_status_2(tmp_path: Path) -> None:
    depth = write_depth(tmp_path / "depth", (60, 80))
    done = taichi_mrf("calibrate", depth, "--true-depth", depth, "--out", tmp_path / "out")
    assert_refused(done, "taichi-mrf: too few samples: 14,400 pixels")
    assert not (tmp_path / "out").exists()


def test_bad_depth_is_refused_in_one_line(tmp_path: Path, refused: Refused) -> None:
    depth = write_depth(tmp_path / "depth", (60, 80))
    large = write_depth(tmp_path / "large", (120, 160))
    assert "a.npy: 160 x 120 pixels, but the camera has 80 x 60" in refused(depth, "--true-depth", large)
    zero = write_depth(tmp_path / "zero", (60, 80), value=0.0)
    assert "none of the 3 depth images contains a measurement" in refused(zero, "--true-depth", depth)
    assert "too few samples: 14,400 pixels" in refused(depth, "--true-depth", depth)
    others = write_depth(tmp_path / "others", (60, 80), names="xyz")
    assert "has no image of the same name" in refused(depth, "--true-depth", others)
    (tmp_path / "nothing").mkdir()
    assert "contains no depth images" in refused(tmp_path / "nothing", "--true-depth", depth)
    assert "is neither a folder nor" in refused(tmp_path / "missing", "--true-depth", depth)
    (depth / "b.npy").write_bytes(b"no array")
    assert "b.npy: cannot be read as an array" in refused(depth, "--true-depth", depth)


def test_bad_stacks_are_refused_in_one_line(tmp_path: Path, refused: Refused) -> None:
    depth = write_depth(tmp_path / "depth", (60, 80))
    stack = tmp_path / "stack.npz"
    np.savez(stack, one=np.zeros((2, 6, 8)), two=np.zeros(3))
    assert "contains no array 'depth_m' but one, two" in refused(stack, "--true-depth", depth)
    np.savez(stack, depth_m=np.zeros(3))
    assert "array of shape (3,), not depth images" in refused(stack, "--true-depth", depth)


def test_bad_chessboards_are_refused_in_one_line(tmp_path: Path, refused: Refused) -> None:
    depth = write_depth(tmp_path / "depth", (240, 320))
    images = tmp_path / "ir"
    images.mkdir()
    assert "contains no images" in refused(
        depth, "--images", images, "--camera", *CAMERA_TEXT.split(), *BOARD_FLAGS
    )
    for name in "ab":
        cv2.imwrite(str(images / f"{name}.png"), np.full((240, 320), 90, np.uint8))
    assert "needs the camera's intrinsics" in refused(depth, "--images", images, *BOARD_FLAGS)
    (depth / "camera.txt").write_text(CAMERA_TEXT, encoding="utf-8")
    assert "8 x 5 inner corners was found in 0 of 2 images" in refused(
        depth, "--images", images, *BOARD_FLAGS
    )
    assert "board.columns must be given" in refused(depth, "--images", images)
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 0 0 0 0 1\n", encoding="utf-8")
    motion = ("--camera-poses", poses, "--board-poses", poses)
    assert "its name is not a stamp in seconds" in refused(depth, "--images", images, *motion, *BOARD_FLAGS)


def test_flags_that_do_not_go_together_are_refused(tmp_path: Path, refused: Refused) -> None:
    depth = write_depth(tmp_path / "depth", (6, 8))
    assert "give one source of true depth: --true-depth, or --images" in refused(depth)
    assert "give one source of true depth: --true-depth, or --images" in refused(
        depth, "--true-depth", depth, "--images", depth
    )
    assert "--camera-poses and --board-poses go together" in refused(
        depth, "--images", depth, "--board-poses", depth
    )
    assert "not a whole number of pixels" in refused(
        depth, "--true-depth", depth, "--camera", "8.5", "6", "9", "9", "4", "3"
    )
    assert "degree must lie between 0 and 4" in refused(depth, "--true-depth", depth, "--degree", "7")


def test_tables_that_do_not_fit_their_camera_are_named(planes_run: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = planes_run
    with np.load(out / "noise.npz") as file:
        arrays = dict(file)
    noise = PatchNoise.load(out / "noise.npz")
    with pytest.raises(ConfigError, match="learnt at 160 x 120 pixels, not 320 x 240"):
        noise.table(PinholeCamera(320, 240, 290, 290, 159, 120))
    for name, change, problem in (
        ("short", {"sigma": arrays["sigma"][:-1]}, "the sigma table has 47 patches"),
        ("camera", {"camera": np.zeros(3)}, "camera is float64"),
        ("patch", {"patch": np.array(0)}, "must be at least 1 pixel"),
    ):
        path = tmp_path / f"{name}.npz"
        np.savez(path, **(arrays | change))
        with pytest.raises(ConfigError, match=f"{name}.npz: .*{problem}"):
            PatchNoise.load(path)
    del arrays["bias"]
    np.savez(tmp_path / "half.npz", **arrays)
    with pytest.raises(ConfigError, match=r"half\.npz: bias is missing"):
        PatchNoise.load(tmp_path / "half.npz")
    with pytest.raises(ConfigError, match=r"missing\.npz: there is no such file"):
        PatchNoise.load(tmp_path / "missing.npz")
