"""``.rrd`` files: Rerun's own tool verifies them, and Rerun's own reader finds what the map has."""

import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from queried_maps import room_map

from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions

pytest.importorskip("rerun", reason=".rrd files need the extra rerun")
reader = pytest.importorskip("rerun.chunk", reason="this version of Rerun reads no chunks")

pytestmark = pytest.mark.usefixtures("one_backend")
BAND = ExportOptions(z_min=-0.9, z_max=0.3)


def read(path: Path) -> dict[str, list[dict[str, Any]]]:
    """By entity the rows of a recording: the values of each component, and its time if it has one."""
    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in reader.RrdReader(path).stream():
        rows = chunk.to_record_batch().drop_columns(["rerun.controls.RowId"])
        found.setdefault(chunk.entity_path, []).extend(rows.to_pylist())
    return found


@pytest.fixture(scope="module")
def exported(backend: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    m, path = room_map("mrf"), tmp_path_factory.mktemp("recording") / "map.rrd"
    assert export_map(m, path, BAND) == [path]
    return m, path


def test_reruns_own_tool_verifies_the_file_without_a_warning(exported: tuple[Any, Path]) -> None:
    tool = Path(sysconfig.get_path("scripts")) / "rerun"
    done = subprocess.run([tool, "rrd", "verify", exported[1]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr
    assert "WARN" not in done.stderr
    assert "ERROR" not in done.stderr


def test_voxels_are_points_with_their_size_and_probability(exported: tuple[Any, Path]) -> None:
    m, path = exported
    (row,) = read(path)["/map/voxels"]
    sizes = 2 * np.array(row["Points3D:radii"], np.float32)
    voxels = np.isclose(sizes, m.voxel_size)
    centres_m, p = m.voxels()
    np.testing.assert_allclose(np.array(row["Points3D:positions"])[voxels], centres_m, atol=1e-5)
    np.testing.assert_array_equal(np.array(row["probability"], np.float32)[voxels], p)
    assert len(row["Points3D:colors"]) == len(sizes)


def test_the_surface_is_that_of_a_mesh(exported: tuple[Any, Path], tmp_path: Path) -> None:
    m, path = exported
    export_map(m, tmp_path / "map.ply", ExportOptions(mesh=True))
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header")[0].decode()
    (row,) = read(path)["/map/surface"]
    assert f"element vertex {len(row['Mesh3D:vertex_positions'])}\n" in header
    assert f"element face {len(row['Mesh3D:triangle_indices'])}\n" in header
    assert len(row["Mesh3D:vertex_colors"]) == len(row["Mesh3D:vertex_positions"])


def test_each_keyframe_has_its_camera_at_its_stamp(exported: tuple[Any, Path]) -> None:
    m, path = exported
    found = read(path)
    in_time = sorted(m.keyframes.values(), key=lambda k: k.stamp_s)
    assert sum(entity.startswith("/map/keyframes/") for entity in found) == len(in_time)
    for number, keyframe in enumerate(in_time):
        (row,) = found[f"/map/keyframes/{number}"]
        camera, T = keyframe.camera, keyframe.T_world_camera
        assert set(row) - {"stamp"} == {key for key in row if ":" in key}  # on this time line only
        assert row["stamp"].timestamp() == pytest.approx(keyframe.stamp_s)
        np.testing.assert_allclose(row["Transform3D:translation"], [T[:3, 3]], atol=1e-6)
        turn = np.reshape(row["Transform3D:mat3x3"], (3, 3)).T  # Rerun's matrices go by columns
        np.testing.assert_allclose(turn, T[:3, :3], atol=1e-6)
        assert row["Pinhole:resolution"] == [[camera.width, camera.height]]
        K = np.reshape(row["Pinhole:image_from_camera"], (3, 3)).T
        # The ray of the first pixel's centre, half a pixel from the image's corner.
        x, y, _ = np.linalg.solve(K, [0.5, 0.5, 1.0])
        np.testing.assert_allclose([x, y, 1.0], camera.directions(0, 0), atol=1e-6)
    ((places_m,),) = (row["LineStrips3D:strips"] for row in found["/map/path"])
    np.testing.assert_allclose(places_m, [k.T_world_camera[:3, 3] for k in in_time], atol=1e-6)


def test_a_costmap_has_the_cells_of_the_floor_plan(exported: tuple[Any, Path], tmp_path: Path) -> None:
    m, path = exported
    export_map(m, tmp_path / "floor.pgm", BAND)
    image = cv2.imread(str(tmp_path / "floor.pgm"), cv2.IMREAD_UNCHANGED)
    (row,) = read(path)["/map/costmap"]
    ((data,), (shape,)) = row["GridMap:data"], row["GridMap:format"]
    assert (shape["height"], shape["width"]) == image.shape
    cells = np.array(data, np.uint8).astype(np.int8).reshape(image.shape)
    for cell, grey in ((100, 0), (0, 254), (-1, 205)):
        np.testing.assert_array_equal(cells == cell, image == grey)
    corner_m = (tmp_path / "floor.yaml").read_text().split("origin: [")[1].split(",")
    assert row["GridMap:translation"][0][:2] == pytest.approx([float(corner_m[0]), float(corner_m[1])])
    assert row["GridMap:cell_size"] == pytest.approx([m.voxel_size])


def test_a_map_whose_rays_are_gone_has_no_cameras(tmp_path: Path) -> None:
    m = room_map("log_odds")
    export_map(m, tmp_path / "map.rrd")
    assert {"/map/voxels", "/map/surface"} <= set(read(tmp_path / "map.rrd"))
