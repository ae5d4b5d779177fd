"""The script that makes the scene of Table I from the authors' files, on files of their layout."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml
from new_interpreter import python

from taichi_mrf.evaluation.experiments.scenes import coffin_scene
from taichi_mrf.geometry.poses import look_at

HEIGHT, WIDTH, PATCHES = 48, 64, 768
K = [50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0]
CAMERA_IN_BODY = [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1]


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.write_bytes(np.array(matrix.shape, "<i8").tobytes() + matrix.astype("<f4").tobytes(order="F"))


@pytest.fixture
def clones(tmp_path: Path) -> tuple[Path, Path]:
    """Both repositories, with images of other depths, and a camera that looks along the body's x."""
    library, wrapper = tmp_path / "mrfmap", tmp_path / "mrfmap_ros"
    for folder in (library / "data", library / "config", wrapper / "config" / "polys"):
        folder.mkdir(parents=True)
    settings = {
        "viewer_params_nodes": {"cam_in_body": CAMERA_IN_BODY},
        "gvdb_params": {"K": K, "rows": HEIGHT, "cols": WIDTH},
    }
    (library / "config" / "coffin_world_640.yaml").write_text(yaml.safe_dump(settings))
    for view in range(12):
        write_matrix(library / "data" / f"depth_{view}.bin", depth_of(view))
        write_matrix(library / "data" / f"pose_{view}.bin", camera_pose(view) @ body_in_camera())
    for name in ("realsense_bias", "realsense_stddev"):
        (wrapper / "config" / "polys" / f"{name}_poly5x.yml").write_text(str(coefficients(name).tolist()))
    return library, wrapper


def depth_of(view: int) -> np.ndarray:
    depth_m = np.arange(HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH) / 4096 + view
    depth_m[0, 1] = np.nan
    return depth_m


def camera_pose(view: int) -> np.ndarray:
    return look_at(np.array([3.0, view / 4, 2.0]), np.zeros(3), (0.0, 0.0, 1.0))


def body_in_camera() -> np.ndarray:
    return np.linalg.inv(np.array(CAMERA_IN_BODY, float).reshape(4, 4))


def coefficients(name: str) -> np.ndarray:
    return np.linspace(0.001, 0.002 + len(name) / 1000, 3 * PATCHES)


def convert(library: Path, wrapper: Path, repository: Path) -> "subprocess.CompletedProcess[str]":
    script = repository / "data" / "make_coffin_world.py"
    return python(script, library, wrapper, library.parent / "coffin_world")


def test_the_scene_has_the_files_views_camera_and_noise(
    clones: tuple[Path, Path], tmp_path: Path, repository: Path
) -> None:
    done = convert(*clones, repository)
    assert (done.returncode, done.stderr) == (0, "")
    scene = coffin_scene(tmp_path)
    assert len(scene.views) == 12
    camera = scene.pinhole
    assert (camera.width, camera.height, camera.fx, camera.cx) == (WIDTH, HEIGHT, 50.0, 31.5)
    for index, view in enumerate(scene.views):
        np.testing.assert_array_equal(view.true_m, np.nan_to_num(depth_of(index)))
        np.testing.assert_allclose(view.T_world_camera, camera_pose(index), atol=1e-6)
    for name in ("realsense_bias", "realsense_stddev"):
        table = np.load(tmp_path / "coffin_world" / f"{name}_poly5x.npy")
        np.testing.assert_array_equal(table.ravel(), coefficients(name).astype(np.float32))


def test_a_damaged_file_is_named(clones: tuple[Path, Path], repository: Path) -> None:
    damaged = clones[0] / "data" / "depth_3.bin"
    damaged.write_bytes(damaged.read_bytes()[:-4])
    done = convert(*clones, repository)
    assert done.returncode == 1
    assert str(damaged) in done.stderr
    assert not (clones[0].parent / "coffin_world").exists()
