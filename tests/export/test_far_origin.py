"""A map whose origin is far from that of the recorded world tells the recorded world's coordinates."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from datasets_recordings import Content, write_tum
from small_room import add, frames

from taichi_mrf.config.schema import Config, VolumeConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.formats import export_map, export_note
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.export.trajectory import write_trajectory
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.change import compare_maps
from taichi_mrf.sensor.frame import Frame

pytestmark = pytest.mark.usefixtures("one_backend")

ORIGIN = (412_000.0, 5_412_000.0, 0.0)


def mapped(origin: tuple[float, float, float] = ORIGIN) -> MRFMap:
    first = frames()[0]
    m = MRFMap.from_config(Config(voxel_size=0.1, volume=VolumeConfig(origin=origin)), first.camera)
    add(m, first)
    m.infer()
    return m


@pytest.fixture(scope="module")
def far() -> MRFMap:
    return mapped()


def test_points_and_surfaces_lie_in_the_recorded_world(far: MRFMap, tmp_path: Path) -> None:
    export_map(far, tmp_path / "voxels.ply")
    centres, _ = far.decided.voxels(0.5)
    points = trimesh.load(tmp_path / "voxels.ply").vertices
    np.testing.assert_array_equal(points, centres + ORIGIN)
    local, m = {}, mapped((0.0, 0.0, 0.0))
    for name in ("mesh.ply", "mesh.obj"):
        export_map(m, tmp_path / name, ExportOptions(mesh=True))
        local[name] = trimesh.load(tmp_path / name, process=False).vertices
        export_map(far, tmp_path / name, ExportOptions(mesh=True))
        vertices = trimesh.load(tmp_path / name, process=False).vertices
        np.testing.assert_allclose(vertices, local[name] + ORIGIN, atol=1e-6)
        assert export_note(far, tmp_path / name) == export_note(m, tmp_path / name)


def test_a_floor_plan_and_a_trajectory_do_too(far: MRFMap, tmp_path: Path) -> None:
    options = ExportOptions(z_min=0.0, z_max=2.0)
    corners = []
    for m in (far, mapped((0.0, 0.0, 0.0))):
        export_map(m, tmp_path / "plan.yaml", options)
        corners.append(yaml.safe_load((tmp_path / "plan.yaml").read_text())["origin"])
    np.testing.assert_allclose(np.subtract(*corners), ORIGIN, atol=1e-6)
    write_trajectory(tmp_path / "way.txt", [(1.0, np.eye(4))], origin_m=ORIGIN)
    assert np.loadtxt(tmp_path / "way.txt")[1:4].tolist() == list(ORIGIN)


def test_files_without_room_for_it_say_so(far: MRFMap, tmp_path: Path) -> None:
    for name in ("map.bt", "map.glb", "map.html"):
        assert "begin at 412000 5412000 0 of the recorded world" in str(export_note(far, tmp_path / name))
    export_map(far, tmp_path / "arrays.npz")
    with np.load(tmp_path / "arrays.npz") as arrays:
        assert arrays["origin"].tolist() == list(ORIGIN)


def test_a_map_file_keeps_it_and_maps_of_two_origins_are_not_compared(far: MRFMap, tmp_path: Path) -> None:
    far.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    assert loaded.config.volume.origin == ORIGIN
    compare_maps(far, loaded)
    with pytest.raises(ConfigError, match=r"origins .* 412000 5412000 0 and 0 0 0"):
        compare_maps(far, mapped((0.0, 0.0, 0.0)))


def test_the_first_frame_of_a_recording_sets_it_and_others_must_have_the_same(tmp_path: Path) -> None:
    content = Content()
    near = [T.copy() for T in content.poses]
    for T in content.poses:
        T[:3, 3] += ORIGIN
    dataset = open_dataset(write_tum(tmp_path / "far", content))
    m = MRFMap(voxel_size=0.1)
    m.add(dataset.read(0))
    assert m.config.volume.origin == tuple(dataset.origin_m) == ORIGIN
    m.add(dataset.read(1))
    m.infer()
    m.save(tmp_path / "map.npz")
    assert load_map(tmp_path / "map.npz").config.volume.origin == ORIGIN
    assert m.decided.config.volume.origin == ORIGIN
    content.poses = near
    other = MRFMap(voxel_size=0.1)
    other.add(open_dataset(write_tum(tmp_path / "near", content)).read(0))
    with pytest.raises(ConfigError, match="its world's origin is 412000 5412000 0, the map's is 0 0 0"):
        other.add(dataset.read(0))


def test_the_recording_sets_it_and_a_box_moves_with_it() -> None:
    class Far(Dataset):
        origin_m = np.array(ORIGIN)  # type: ignore[assignment]
        endless = True  # type: ignore[assignment]
        frame_names = ()  # type: ignore[assignment]

        def read(self, index: int) -> Frame:
            raise IndexError(index)

    given = Config(
        volume=VolumeConfig(lower=(412_001.0, 5_412_002.0, -1.0), upper=(412_009.0, 5_412_003.0, 2.0))
    )
    dataset = Far("far", frames()[0].camera)
    volume = with_recorded_noise(given, dataset).volume
    assert (volume.origin, volume.lower, volume.upper) == (ORIGIN, (1.0, 2.0, -1.0), (9.0, 3.0, 2.0))
    assert with_recorded_noise(with_recorded_noise(given, dataset), dataset).volume == volume
