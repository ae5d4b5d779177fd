"""--robot: what a URDF's geometry covers at the frame's stamp is no measurement."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armed_room import HALF_M, bar_depth_m, missed_m, to_bar_m, write_urdf
from datasets_recordings import Content, write_seven_scenes
from refusals import bad_frame, refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.conventions import AS_USUAL
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")
CAMERA = PinholeCamera(160, 120, 131.25, 131.25, 79.5, 59.5)
MARGIN_M = 0.02


@pytest.fixture
def arm(tmp_path: Path) -> OwnBody:
    pytest.importorskip("yourdfpy")
    (tmp_path / "joints.csv").write_text("stamp, elbow\n10, -0.4\n12, 0\n")
    urdf = write_urdf(tmp_path / "arm.urdf")
    return OwnBody(robot=str(urdf), camera_link="optical", joints=str(tmp_path / "joints.csv"))


def frame(depth_m: np.ndarray, stamp: float) -> Frame:
    return Frame(depth_m.astype(np.float32), np.eye(4), CAMERA, stamp, "one")


@pytest.mark.parametrize(("stamp", "angle"), [(10.0, -0.4), (11.0, -0.2), (11.5, -0.1), (12.0, 0.0)])
def test_the_grown_body_covers_what_passes_near_it(arm: OwnBody, stamp: float, angle: float) -> None:
    """Also where nothing is measured, as the body may be why. Joints are linear between stamps."""
    from taichi_mrf.datasets.robot_model import RobotModel

    model, missed = RobotModel(arm, AS_USUAL), missed_m(CAMERA, angle)
    for depth_m in (np.full(CAMERA.shape, 5.0), np.zeros(CAMERA.shape)):
        covered, _ = model.covered(frame(depth_m, stamp))
        assert covered[missed < 0.85 * MARGIN_M].all()
        assert not covered[missed > 1.1 * MARGIN_M].any()


def test_things_in_front_of_the_body_stay(arm: OwnBody) -> None:
    from taichi_mrf.datasets.robot_model import RobotModel

    model, bar = RobotModel(arm, AS_USUAL), bar_depth_m(CAMERA, -0.4)
    there = np.isfinite(bar)
    assert there.sum() > 500
    for nearer_m, kept in ((0.0, False), (0.01, False), (0.1, True), (-0.3, False)):
        depth_m = np.where(there, bar - nearer_m, 3.0)
        depth_m = np.where(depth_m > 0.05, depth_m, 0.05)
        covered, _ = model.covered(frame(depth_m, 10.0))
        far = to_bar_m(CAMERA.rays() * depth_m[..., None], -0.4) > 1.05 * MARGIN_M
        if kept:
            assert not covered[there & far & (depth_m < bar)].any()
        else:
            assert covered[there].all()


@pytest.mark.parametrize("shape", ["box", "cylinder", "ball", "torus", "open"])
def test_the_grown_surface_lies_at_the_margin(shape: str) -> None:
    """No corner is further away than it, and from outside nothing is seen that is clearly nearer."""
    from taichi_mrf.datasets.robot_model import grown

    mesh = {
        "box": lambda: trimesh.creation.box((0.06, 0.08, 0.4)),
        "cylinder": lambda: trimesh.creation.cylinder(0.05, 0.3, sections=32),
        "ball": lambda: trimesh.creation.icosphere(3, 0.1),
        "torus": lambda: trimesh.creation.torus(0.1, 0.03),
        "open": lambda: trimesh.Trimesh(
            [[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0.2, 0.2, 0.1]], [[0, 1, 2], [1, 3, 2]]
        ),
    }[shape]()
    surface = grown(TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces, np.int32)), MARGIN_M)
    samples = mesh.triangles
    corners = surface.vertices[:: max(1, len(surface.vertices) // 400)]
    for corner in corners:
        closest = trimesh.triangles.closest_point(samples, np.broadcast_to(corner, (len(samples), 3)))
        assert np.linalg.norm(closest - corner, axis=1).min() <= MARGIN_M + 1e-6
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    bounds = np.array(mesh.bounds)
    np.testing.assert_allclose(
        [low, high], [bounds[0] - MARGIN_M, bounds[1] + MARGIN_M], atol=0.15 * MARGIN_M
    )


def test_a_mesh_file_of_a_package_is_found(tmp_path: Path, arm: OwnBody) -> None:
    from taichi_mrf.datasets.robot_model import RobotModel

    (tmp_path / "pkg" / "urdf").mkdir(parents=True)
    (tmp_path / "pkg" / "meshes").mkdir()
    trimesh.creation.box(2 * HALF_M).export(tmp_path / "pkg" / "meshes" / "bar.stl")
    urdf = tmp_path / "pkg" / "urdf" / "arm.urdf"
    write_urdf(urdf, '<mesh filename="package://pkg/meshes/bar.stl"/>')
    plain, meshes = RobotModel(arm, AS_USUAL), RobotModel(replace(arm, robot=str(urdf)), AS_USUAL)
    wall = frame(np.full(CAMERA.shape, 3.0), 10.7)
    for one, other in zip(meshes.covered(wall), plain.covered(wall), strict=True):
        assert one.any()
        np.testing.assert_array_equal(one, other)
    write_urdf(urdf, '<mesh filename="package://pkg/meshes/gone.stl"/>')
    folder = write_seven_scenes(tmp_path / "office", Content())
    refused(
        folder, "arm.urdf", "package://pkg/meshes/gone.stl is missing", body=replace(arm, robot=str(urdf))
    )


def test_what_is_around_the_sensor_is_left_out(tmp_path: Path, arm: OwnBody) -> None:
    folder = write_seven_scenes(tmp_path / "office", Content())
    dataset = open_dataset(folder, body=replace(arm, joints=None))
    (note,) = [note for note in dataset.notes if note.startswith("own body")]
    assert note.startswith("own body: 1 parts of ")
    assert "around the sensor, and left out: " in note


def test_what_is_wrong_is_one_line(tmp_path: Path, arm: OwnBody) -> None:
    folder = write_seven_scenes(tmp_path / "office", Content())

    def said(*words: str, **changed: str) -> None:
        refused(folder, *words, body=replace(arm, **changed))

    def joints(name: str, text: str, *words: str) -> None:
        (tmp_path / name).write_text(text)
        said(name, *words, joints=str(tmp_path / name))

    said("the URDF is missing", robot=str(tmp_path / "gone.urdf"))
    (tmp_path / "text.urdf").write_text("a robot")
    said("text.urdf: cannot be read as a URDF", robot=str(tmp_path / "text.urdf"))
    said("--camera-link: no link 'optcal'; did you mean 'optical'?", camera_link="optcal")
    said("gone.csv", "missing", joints=str(tmp_path / "gone.csv"))
    joints("a.yaml", "elbw: 1", "has no joint 'elbw'; did you mean 'elbow'?")
    joints("b.yaml", "[1, 2]", "expected joints as 'name: value'")
    joints("a.csv", "elbow\n1\n", "its first line must be stamp,JOINT,...")
    joints("b.csv", "stamp,elbow\n1,2\n2,nan\n", "line 3: expected 2 numbers, not '2,nan'")
    joints("c.csv", "stamp,elbow\n2,2\n1,2\n", "stamps rise")
    joints("d.csv", "stamp,elbow\n", "stamps rise")
    bad_frame(open_dataset(folder, body=arm), 0, "joints are known from 10.000 to 12.000 s")


def test_flags_that_do_not_go_together() -> None:
    for flags in ({"robot": "a"}, {"camera_link": "a"}, {"joints": "a"}):
        with pytest.raises(ConfigError, match="--robot needs --camera-link"):
            SourceFlags(**flags)
    with pytest.raises(ConfigError, match="--body-margin must be a number of metres"):
        SourceFlags(body_margin=-1.0)


def test_without_yourdfpy_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    folder = write_seven_scenes(tmp_path / "office", Content())
    body = OwnBody(robot=str(write_urdf(tmp_path / "arm.urdf")), camera_link="optical")
    text = refused(folder, body=body)
    assert text == "a robot's URDF needs yourdfpy, which is not installed: pip install 'taichi-mrf[robot]'"
