"""``.mcap`` files, read back by MCAP's own library, and their messages by independent decoders."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from queried_maps import room_map

from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.queries.points import FREE, OCCUPIED

mcap = pytest.importorskip("mcap.reader", reason="MCAP files are read by its own library: pip install mcap")
protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="pip install mcap-protobuf-support")
pytest.importorskip("foxglove", reason=".mcap files need the extra robot")
typesys = pytest.importorskip("rosbags.typesys", reason="messages of ROS need the extra robot")

pytestmark = pytest.mark.usefixtures("one_backend")
BAND = {"z_min": -0.9, "z_max": 0.3}


def read(path: Path) -> dict[str, list[tuple[int, str, Any]]]:
    """By topic the log time, the type and the message of each; messages of ROS as bytes."""
    found: dict[str, list[tuple[int, str, Any]]] = {}
    decoders = protobuf.DecoderFactory()
    with open(path, "rb") as file:
        reader = mcap.make_reader(file)
        for schema, channel, message in reader.iter_messages():
            decode = decoders.decoder_for(channel.message_encoding, schema)
            content = message.data if decode is None else decode(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, schema.name, content))
            if decode is None:
                assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
                own = typesys.get_types_from_msg(schema.data.decode(), schema.name)
                assert schema.name in own
    return found


@pytest.fixture(scope="module")
def exported(backend: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    m, folder = room_map("mrf"), tmp_path_factory.mktemp("messages")
    export_map(m, folder / "map.mcap", ExportOptions(**BAND))
    return m, folder


def test_a_costmap_has_the_cells_of_the_floor_plan(exported: tuple[Any, Path]) -> None:
    m, folder = exported
    export_map(m, folder / "floor.pgm", ExportOptions(**BAND))
    image = cv2.imread(str(folder / "floor.pgm"), cv2.IMREAD_UNCHANGED)
    ((time_ns, name, content),) = read(folder / "map.mcap")["/map/costmap"]
    assert name == "nav_msgs/msg/OccupancyGrid"
    grid = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE).deserialize_cdr(content, name)
    cells = np.flipud(grid.data.reshape(grid.info.height, grid.info.width))
    np.testing.assert_array_equal(cells == 100, image == 0)
    np.testing.assert_array_equal(cells == 0, image == 254)
    np.testing.assert_array_equal(cells == -1, image == 205)
    assert grid.info.resolution == pytest.approx(m.voxel_size)
    origin = (folder / "floor.yaml").read_text().split("origin: [")[1].split(",")
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == pytest.approx(
        (float(origin[0]), float(origin[1]))
    )
    assert grid.header.frame_id == "map"
    assert time_ns == round(1e9 * max(k.stamp_s for k in m.keyframes.values()))


def test_an_octree_has_the_states_of_the_map(exported: tuple[Any, Path], tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", reason="OctoMap itself is not here: pip install pyoctomap")
    m, folder = exported
    ((_, name, content),) = read(folder / "map.mcap")["/map/octomap"]
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    text = "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"
    store.register(typesys.get_types_from_msg(text, name))
    message = store.deserialize_cdr(content, name)
    assert (message.binary, message.id, message.resolution) == (True, "OcTree", m.voxel_size)
    export_map(m, tmp_path / "map.bt")
    header = (tmp_path / "map.bt").read_bytes().split(b"data\n", 1)[0] + b"data\n"
    (tmp_path / "sent.bt").write_bytes(header + message.data.tobytes())
    tree = pyoctomap.OcTree(str(tmp_path / "sent.bt").encode())
    centres_m = m.voxels(0.0)[0]
    state = m.state(centres_m)
    known = np.isin(state, (FREE, OCCUPIED))
    for point, here in list(zip(centres_m[known], state[known], strict=True))[::97]:
        node = tree.search(point)
        assert node is not None
        assert tree.isNodeOccupied(node) == (here == OCCUPIED)


def test_viewers_get_voxels_the_surface_and_the_cameras_path(exported: tuple[Any, Path]) -> None:
    m, folder = exported
    found = read(folder / "map.mcap")
    ((_, name, cloud),) = found["/map/voxels"]
    assert (name, cloud.frame_id) == ("foxglove.PointCloud", "map")
    assert [field.name for field in cloud.fields][:5] == ["x", "y", "z", "probability", "size"]
    assert cloud.point_stride == 20
    values = np.frombuffer(cloud.data, "<f4").reshape(-1, 5)
    voxels = values[values[:, 4] == np.float32(m.voxel_size)]
    centres_m, p = m.voxels()
    np.testing.assert_allclose(voxels[:, :3], centres_m, atol=1e-5)
    np.testing.assert_array_equal(voxels[:, 3], p)
    ((_, _, update),) = found["/map/surface"]
    (triangles,) = update.entities[0].triangles
    assert len(triangles.indices) % 3 == 0
    assert 0 <= min(triangles.indices) <= max(triangles.indices) < len(triangles.points)
    assert len(triangles.colors) == len(triangles.points)
    ((_, _, path),) = found["/map/path"]
    in_time = sorted(m.keyframes.values(), key=lambda k: k.stamp_s)
    assert len(path.poses) == len(found["/tf"]) == len(in_time)
    for pose, (time_ns, _, sent), keyframe in zip(path.poses, found["/tf"], in_time, strict=True):
        (transform,) = sent.transforms
        assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "camera")
        assert time_ns == round(1e9 * keyframe.stamp_s)
        place = pose.position.x, pose.position.y, pose.position.z
        assert place == pytest.approx(tuple(keyframe.T_world_camera[:3, 3]))
        x, y, z, w = (getattr(pose.orientation, name) for name in "xyzw")
        forwards = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        np.testing.assert_allclose(forwards, keyframe.T_world_camera[:3, 2], atol=1e-9)


def test_without_a_band_of_heights_there_is_no_costmap(tmp_path: Path) -> None:
    m = room_map("log_odds")
    export_map(m, tmp_path / "map.mcap")
    found = read(tmp_path / "map.mcap")
    assert "/map/costmap" not in found
    assert {"/map/voxels", "/map/octomap", "/map/surface"} <= set(found)


def test_a_plan_whose_up_is_not_z_stands_in_the_world(tmp_path: Path) -> None:
    m = room_map("mrf")
    export_map(m, tmp_path / "map.mcap", ExportOptions(**BAND, up="-y"))
    export_map(m, tmp_path / "floor.pgm", ExportOptions(**BAND, up="-y"))
    ((_, name, content),) = read(tmp_path / "map.mcap")["/map/costmap"]
    grid = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE).deserialize_cdr(content, name)
    row, column = np.argwhere(grid.data.reshape(grid.info.height, grid.info.width) == 100)[0]
    p, q = grid.info.origin.position, grid.info.origin.orientation
    x, y, z, w = q.x, q.y, q.z, q.w
    right = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    forwards = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    there = np.array([p.x, p.y, p.z]) + m.voxel_size * ((column + 0.5) * right + (row + 0.5) * forwards)
    heights_m = np.arange(-BAND["z_max"], -BAND["z_min"], m.voxel_size / 2)
    column_m = np.tile(there, (len(heights_m), 1))
    column_m[:, 1] = heights_m
    assert (m.state(column_m) == OCCUPIED).any()
