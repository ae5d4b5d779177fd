"""Queries take what speaks DLPack and answer in kind: with a stand-in made of NumPy, and with torch."""

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from queried_maps import room_map

from taichi_mrf.errors import ArgumentTypeError, ConfigError
from taichi_mrf.methods.brick_map import BrickMap
from taichi_mrf.queries import cast, given_rays
from taichi_mrf.queries.box import read_box
from taichi_mrf.queries.cast import cast_rays
from taichi_mrf.queries.distance import DistanceField
from taichi_mrf.queries.gain import view_gain
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system import runtime, tensors
from taichi_mrf.voxels import topology

POINTS = np.random.default_rng(0).uniform((-2.2, 0.9, -1.4), (0.2, 3.2, 0.9), (50, 3))
CAMERA = PinholeCamera(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5)


class Tensor:
    """Another library's array: it can be read by DLPack, and by nothing else."""

    device: ClassVar[tuple[int, int]] = (1, 0)

    def __init__(self, values: Any) -> None:
        self.values = np.asarray(values)

    def __dlpack__(self, **options: Any) -> Any:
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.device

    def __array_namespace__(self) -> Any:
        return TensorLibrary

    @property
    def __array__(self) -> Any:
        raise AssertionError("read as something else than DLPack")


class TensorLibrary:
    @staticmethod
    def from_dlpack(array: Any) -> Tensor:
        return Tensor(np.from_dlpack(array))


class OnDevice(Tensor):
    """One in the memory of a device."""

    device = (2, 0)


@dataclass
class Mute:
    """A tensor of a library that cannot be asked to make one."""

    values: np.ndarray

    def __dlpack__(self, **options: Any) -> Any:
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return 1, 0


def queries(m: BrickMap) -> dict[str, Any]:
    """Every query that takes points, rays or poses, as functions of what makes an argument of an array."""
    poses = np.stack([np.eye(4)] * 2)
    field = DistanceField(m, 0.4)
    return {
        "occupancy": lambda made: m.occupancy(made(POINTS)),
        "state": lambda made: m.state(made(POINTS)),
        "occupied_within": lambda made: m.occupied_within(points=made(POINTS), radius_m=0.2),
        "path_collision": lambda made: m.path_collision(made(POINTS), 0.2),
        "many paths": lambda made: m.path_collision(made(POINTS.reshape(5, 10, 3)), 0.2),
        "ray_profile": lambda made: m.ray_profile(made(POINTS[0]), np.array([1.0, 0, 0])).occupancy,
        "render_depth": lambda made: m.render_depth(CAMERA, made(np.eye(4))),
        "view_gain": lambda made: view_gain(m, CAMERA, made(poses), 3.0),
        "hit": lambda made: cast_rays(m, np.zeros(3), made(POINTS), 3.0).hit,
        "range": lambda made: cast_rays(m, made(np.zeros(3)), POINTS, 3.0).range,
        "point": lambda made: cast_rays(m, made(POINTS), made(POINTS), 3.0, "stop").point,
        "distance": lambda made: field.distance(made(POINTS)),
        "float32": lambda made: field.distance(made(POINTS.astype(np.float32))),
        "gradient": lambda made: field.distance_and_gradient(made(POINTS))[1],
        "clearance": lambda made: field.clearance(made(POINTS.reshape(10, 5, 3)), made(np.full(5, 0.1))),
    }


def test_answers_come_in_kind(backend: str) -> None:
    for name, ask in queries(room_map("mrf")).items():
        wanted, found = ask(np.asarray), ask(Tensor)
        assert isinstance(wanted, np.ndarray | np.generic), name
        assert isinstance(found, Tensor), name
        assert found.values.dtype == np.asarray(wanted).dtype, name
        np.testing.assert_array_equal(found.values, wanted, err_msg=name)


def test_tensors_are_read_where_they_lie() -> None:
    tensor = Tensor(POINTS.copy())
    assert np.shares_memory(tensors.on_host(tensor, "points"), tensor.values)
    assert tensors.real_array(POINTS, "points", ("N", 3)) is POINTS
    assert tensors.on_host([1, 2], "points") == [1, 2]


SINGLE = POINTS.astype(np.float32)
ON_DEVICE = {"occupancy", "state", "hit", "range", "point", "distance", "float32", "gradient", "clearance"}
"""The queries of which nothing but small things is copied to the host."""


def test_float32_answers_as_float64_of_the_same_values(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "POINTS", SINGLE.astype(np.float64))
    for name, ask in queries(room_map("mrf")).items():
        double, single = (ask(lambda a, d=d: np.asarray(a, d)) for d in (np.float64, np.float32))
        np.testing.assert_array_equal(single, double, err_msg=name)
        assert np.asarray(single).dtype == np.asarray(double).dtype, name


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("made", [np.asarray, Tensor])
def test_points_and_rays_reach_kernels_where_they_lie(
    one_backend: str, made: Any, dtype: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, ways = POINTS.astype(dtype), -POINTS.astype(dtype)
    seen: list[np.ndarray] = []

    def spy(
        patch: pytest.MonkeyPatch, module: Any, name: str, arrays: Callable[..., tuple[np.ndarray, ...]]
    ) -> None:
        kernel = getattr(module, name)

        def launch(*arguments: Any) -> Any:
            seen.extend(arrays(*arguments))
            return kernel(*arguments)

        patch.setattr(module, name, launch)

    m = room_map("mrf")
    with monkeypatch.context() as patch:
        spy(patch, topology.SparseTopology, "locate", lambda index, points, *_: (points,))
        m.occupancy(made(points))
        m.state(made(points))
    assert len(seen) == 2
    for module, name in ((given_rays, "_bound"), (given_rays, "_follow"), (cast, "_cast")):
        spy(monkeypatch, module, name, lambda rays, *_: (rays.origins, rays.directions))
    for unknown in ("free", "stop"):
        cast_rays(m, made(points), made(ways), 3.0, unknown)  # type: ignore[arg-type]
    assert len(seen) == 2 + 12
    for array in seen:
        assert np.shares_memory(array, points) or np.shares_memory(array, ways)


def test_what_kernels_cannot_read_is_converted(backend: str) -> None:
    m = room_map("mrf")
    for odd in (POINTS.astype(">f8"), POINTS[::-1][::-1], np.asfortranarray(POINTS), POINTS.tolist()):
        np.testing.assert_array_equal(m.state(odd), m.state(POINTS))
        np.testing.assert_array_equal(
            cast_rays(m, odd, odd, 3.0).range, cast_rays(m, POINTS, POINTS, 3.0).range
        )
    whole = np.rint(POINTS)
    np.testing.assert_array_equal(m.state(whole.astype(int)), m.state(whole))
    np.testing.assert_array_equal(m.state(whole.astype(np.float16)), m.state(whole))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_on_faces_belong_to_the_voxel_that_numpy_says(backend: str, dtype: type) -> None:
    m = room_map("mrf")
    i = np.arange(-60, 60)
    faces = np.concatenate([i * m.voxel_size, i / round(1 / m.voxel_size)]).astype(dtype)
    points = np.stack(np.meshgrid(faces[::7], faces[::5], faces[::3], indexing="ij"), axis=-1).reshape(-1, 3)
    middles = (np.floor(points.astype(np.float64) / m.voxel_size) + 0.5) * m.voxel_size
    assert len(np.unique(m.state(middles))) == 3
    np.testing.assert_array_equal(m.occupancy(points), m.occupancy(middles))


def test_boxes_take_tensors_and_return_numpy(backend: str) -> None:
    m = room_map("mrf")
    box = read_box(m, Tensor([-1.0, -1.0, -1.0]), Tensor([1.0, 1.0, 0.5]))
    np.testing.assert_array_equal(box.state, read_box(m, (-1, -1, -1), (1, 1, 0.5)).state)


def test_a_library_that_makes_no_arrays_gets_those_of_numpy(backend: str) -> None:
    found = room_map("mrf").state(Mute(POINTS))
    assert isinstance(found, np.ndarray)
    np.testing.assert_array_equal(found, room_map("mrf").state(POINTS))


def test_what_cannot_be_read(one_backend: str) -> None:
    m = room_map("mrf")
    with pytest.raises(
        ArgumentTypeError, match=r"^points lies in the memory of a device .*Taichi, on cpu, .*$"
    ):
        m.occupancy(OnDevice(POINTS))
    with pytest.raises(ArgumentTypeError, match="centres lies in the memory of a device"):
        DistanceField(m, 0.4).clearance(OnDevice(POINTS[None]), np.full(50, 0.1))
    with pytest.raises(ArgumentTypeError, match=r"^points cannot be read by DLPack: "):
        m.occupancy(Tensor(np.array(["a", "b"])))
    with pytest.raises(ConfigError, match=r"shape \(N, 3\), not \(50,\)"):
        m.occupancy(Tensor(POINTS[:, 0]))
    with pytest.raises(ConfigError, match="points hold a value that is not finite"):
        tensors.real_array(np.array([[np.inf, -np.inf, 0.0]]), "points", ("N", 3))
    large = np.full((2, 3), 1.5e308)
    assert tensors.real_array(large, "points", ("N", 3)) is large


@pytest.fixture(scope="module")
def torch() -> Any:
    return pytest.importorskip("torch", reason="torch is not installed: pip install torch")


def test_torch_gets_torch(backend: str, torch: Any) -> None:
    for name, ask in queries(room_map("mrf")).items():
        wanted, found = ask(np.asarray), ask(lambda array: torch.from_numpy(array.copy()))
        assert isinstance(found, torch.Tensor), name
        np.testing.assert_array_equal(found.numpy(), wanted, err_msg=name)


def test_a_tensor_that_keeps_gradients_is_refused(one_backend: str, torch: Any) -> None:
    with pytest.raises(ArgumentTypeError, match=r"points cannot be read by DLPack: .*grad"):
        room_map("mrf").occupancy(torch.zeros((2, 3), requires_grad=True))


def test_tensors_on_a_gpu_stay_there(backend: str, torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if backend != "cuda" or not torch.cuda.is_available():
        pytest.skip("needs Taichi and PyTorch on CUDA: pytest --arch cuda on a machine that has it")
    to_host = torch.Tensor.cpu

    def small(tensor: Any) -> Any:
        assert tensor.numel() < len(POINTS)
        return to_host(tensor)

    for name, ask in queries(room_map("mrf")).items():
        wanted = ask(np.asarray)
        with monkeypatch.context() as patch:
            if name in ON_DEVICE:
                patch.setattr(torch.Tensor, "cpu", small)
            found = ask(lambda array: torch.from_numpy(array.copy()).cuda())
        assert found.device.type == "cuda", name
        np.testing.assert_allclose(found.cpu().numpy(), wanted, rtol=1e-6, atol=1e-6, err_msg=name)


def test_kernels_read_and_write_tensors_of_their_device(
    one_backend: str, torch: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on CUDA, with a CPU in its place: nothing becomes a NumPy array."""
    field = DistanceField(room_map("mrf"), 0.4)
    wanted = field.distance_and_gradient(POINTS)
    balls = field.clearance(POINTS.reshape(10, 5, 3), np.full(5, 0.1))
    m = room_map("mrf")
    at_points = m.occupancy(POINTS), m.state(POINTS)
    rays = cast_rays(m, np.zeros(3), POINTS, 3.0, "stop")
    monkeypatch.setattr(tensors, "_HOST", 99)
    monkeypatch.setattr(tensors, "_CUDA", 1)
    monkeypatch.setattr(runtime, "active", lambda: "cuda")
    monkeypatch.setattr(np, "from_dlpack", None)
    given = torch.from_numpy(POINTS.copy())
    found = field.distance_and_gradient(given)
    assert all(isinstance(each, torch.Tensor) and each.dtype == torch.float32 for each in found)
    np.testing.assert_array_equal(found[0].numpy(), wanted[0])
    np.testing.assert_array_equal(found[1].numpy(), wanted[1])
    np.testing.assert_array_equal(
        field.distance(given.float().double()).numpy(), field.distance(given.float())
    )
    np.testing.assert_array_equal(field.clearance(given.reshape(10, 5, 3), np.full(5, 0.1)), balls)
    for found_there, wanted_there in zip((m.occupancy(given), m.state(given)), at_points, strict=True):
        assert isinstance(found_there, torch.Tensor)
        # torch's tanh and NumPy's may differ by a rounding of 1
        np.testing.assert_allclose(found_there.numpy(), wanted_there, rtol=0, atol=2**-24)
        assert found_there.numpy().dtype == wanted_there.dtype
    for start, way in ((np.zeros(3), given), (torch.zeros(3), given), (given * 0, given.float().double())):
        ends = cast_rays(m, start, way, 3.0, "stop")
        for each in dataclasses.fields(rays):
            there, wanted_there = getattr(ends, each.name), getattr(rays, each.name)
            assert isinstance(there, torch.Tensor), each.name
            if way is given:
                np.testing.assert_array_equal(there.numpy(), wanted_there, err_msg=each.name)
    with pytest.raises(ConfigError, match="a ray has a direction of no length"):
        cast_rays(m, np.zeros(3), given * 0, 3.0)
    with pytest.raises(ConfigError, match="points hold a value that is not finite"):
        field.distance(given * np.nan)
    with pytest.raises(ConfigError, match="points hold a value that is not finite"):
        m.state(given * np.nan)
