"""The part of a map file that all mapping methods share. A map file is one .npz that NumPy alone can read.

The header holds the format, the method, the whole configuration, the noise model, and the keyframes' images
and poses. Each method stores its bricks itself. The manifest lists all members with their checksums, so that
a damaged or incomplete file is detected.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.config.values import from_dict
from taichi_mrf.errors import CapacityError, MapFileError, TaichiMRFError, said
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.geometry.up import UP_NAMES, Up, up_from_name, up_name, up_of
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.methods.sensor_section import describing
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.sensor.own_evidence import NOTHING, OwnEvidence
from taichi_mrf.sensor.pose_doubt import checked_covariance
from taichi_mrf.sensor.stored import is_stored, read_stored, stored_arrays
from taichi_mrf.system.later import later
from taichi_mrf.system.npz_file import NpzFile, open_npz
from taichi_mrf.voxels.layers import pixel_layers
from taichi_mrf.voxels.layout import VOXELS, grid_keys
from taichi_mrf.voxels.topology import SparseTopology

if TYPE_CHECKING:
    from taichi_mrf.queries import free
    from taichi_mrf.queries.free import FreePromise
else:
    (free,) = later("taichi_mrf.queries", "free")

FORMAT = 4
"""The newest format. Format 2 added the manifest, format 3 cameras that are no pinholes, format 4 messages of
frozen keyframes that wait for older ones."""

CAMERAS_FORMAT, PINHOLE_FORMAT = 3, 2
"""The formats that are written where no messages wait, and where all cameras are pinholes, too: earlier
versions can read these."""

READABLE = (1, 2, 3, 4)
"""The formats that can be read."""

NUMBERS = "keyframe_camera_numbers"
"""Files with cameras that are no pinholes have this member."""

_CAMERA_ROWS = "keyframe_cameras"
_CAMERA_ROW = 6
_NOISE = "noise_"


@dataclass(frozen=True)
class StoredKeyframe:
    """A keyframe in host memory, as it is saved; recursive maps hold their keyframes in this form.

    ``depth_m`` is (H, W) float32 axial depth in metres, 0 where there is no measurement, ``stamp_s`` when it
    was taken, in seconds, ``color`` (H, W, 3) uint8 RGB or None, and ``own`` what it states of its
    measurements.
    """

    id: int
    name: str
    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: Camera
    stamp_s: float
    color: NDArray[np.uint8] | None = None
    own: OwnEvidence = NOTHING

    @staticmethod
    def of(k: Keyframe) -> "StoredKeyframe":
        """A keyframe of an MRFMap."""
        return StoredKeyframe(k.id, k.name, k.depth_m, k.T_world_camera, k.camera, k.stamp_s, k.color, k.own)

    @property
    def rays(self) -> int:
        """Number of pixels that hold a measurement."""
        return int((self.depth_m > 0).sum())

    @property
    def image_bytes(self) -> int:
        """Bytes of the depth image and of what the keyframe states of it."""
        return self.depth_m.nbytes + self.own.nbytes


@dataclass(frozen=True)
class MapHeader:
    """Contents of the files of all methods; ``config.method`` names the method. ``settled`` says whether the
    voxels are those that a full inference of these keyframes gives; ``up`` is the world axis that is up, None
    if it is unknown; ``promise`` is what levels of free space mean, None if the map was not calibrated."""

    config: Config
    noise: NoiseModel
    keyframes: list[StoredKeyframe]
    next_id: int
    settled: bool = True
    up: Up | None = None
    promise: "FreePromise | None" = None

    @property
    def up_axis(self) -> str:
        """The name of the axis that is up, empty if it is unknown."""
        return up_name(self.up) if self.up else ""

    def limited_to(self, memory_limit_gb: float | None) -> Config:
        """The configuration, with another memory limit unless it is None."""
        if memory_limit_gb is None:
            return self.config
        volume = replace(self.config.volume, memory_limit_gb=memory_limit_gb)
        return replace(self.config, volume=volume)

    def arrays(self) -> dict[str, NDArray]:
        """The header as arrays by name. Raises MapFileError for a camera or a noise model that cannot be
        saved."""
        keyframes = self.keyframes
        cameras = camera_arrays([k.camera for k in keyframes])
        arrays: dict[str, NDArray] = {
            "format": np.asarray(CAMERAS_FORMAT if NUMBERS in cameras else PINHOLE_FORMAT),
            "method": np.asarray(self.config.method),
            "config": np.asarray(to_yaml(self.config)),
            "keyframe_ids": np.array([k.id for k in keyframes], np.int64),
            "keyframe_names": np.array([k.name for k in keyframes], np.str_),
            "keyframe_T_world_camera": np.array([k.T_world_camera for k in keyframes]).reshape(-1, 4, 4),
            **cameras,
            "keyframe_stamps": np.array([k.stamp_s for k in keyframes], np.float64),
            "next_id": np.asarray(self.next_id),
            "settled": np.asarray(self.settled),
            "up": np.asarray(self.up_axis),
            **stored_arrays(self.noise, _NOISE),
            **({} if self.promise is None else promise_arrays(self.promise)),
        }
        for number, keyframe in enumerate(keyframes):
            arrays[f"keyframe_depth_{number}"] = keyframe.depth_m
            if keyframe.color is not None:
                arrays[f"keyframe_color_{number}"] = keyframe.color
            arrays |= evidence_arrays(keyframe.own, f"keyframe_{number}_")
        return arrays


@contextmanager
def open_map_file(path: Path, method: str | None = None) -> Iterator[NpzFile]:
    """The arrays of a map file, by name. Raises MapFileError, which names the file, for a damaged file, for a
    map of another ``method`` (None accepts all), and for errors of this package inside the ``with`` block."""
    with naming(path), open_npz(path, MapFileError, "a readable map") as file:
        if "format" not in file:
            raise MapFileError(f"{path}: not a map of taichi_mrf")
        format = file.scalar("format", "iu")
        if format not in READABLE:
            newer = ", by a newer version" if format > FORMAT else ""
            raise MapFileError(
                f"{path}: written in format {format}{newer}; this version reads formats 1 to {FORMAT}"
            )
        if format > 1:
            file.check_manifest()
        found = method_of(file)
        check_registered(path, found)
        if method is not None and found != method:
            raise MapFileError(
                f"{path}: a map of the method '{found}', which {METHODS[found].class_name}.load reads, "
                f"not {METHODS[method].class_name}.load"
            )
        yield file


def check_registered(path: Path, method: str) -> None:
    """Raise MapFileError if a file's mapping method is not among those of this program."""
    if method not in METHODS:
        raise MapFileError(
            f"{path}: saved by the mapping method '{method}', which is not registered (registered: "
            f"{', '.join(METHODS)}): load it with the program that adds this method to "
            "taichi_mrf.config.plugs.PLUGS, or update taichi_mrf"
        )


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of this package in the block are raised again with the file's name: CapacityError as
    CapacityError, all others as MapFileError."""
    try:
        yield
    except TaichiMRFError as error:
        kind = CapacityError if isinstance(error, CapacityError) else MapFileError
        raise kind(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error


def method_of(file: NpzFile) -> str:
    """The name of the mapping method of a map file. The first maps have no such entry; they are all mrf."""
    return file.scalar("method", "U") if "method" in file else "mrf"


def read_header(path: Path, file: NpzFile) -> MapHeader:
    """The header of an open file."""
    ids = file.array("keyframe_ids", "i", (None,))
    n = len(ids)
    names = file.array("keyframe_names", "U", (n,)).tolist()
    poses = file.array("keyframe_T_world_camera", "f", (n, 4, 4))
    cameras = read_cameras(file, n)
    # Earlier versions saved no stamps: without one, the number of a keyframe counts.
    stamps = file.array("keyframe_stamps", "f", (n,)) if "keyframe_stamps" in file else ids.astype(np.float64)
    keyframes = []
    for i, id in enumerate(ids.tolist()):
        camera = cameras[i]
        depth_m = file.array(f"keyframe_depth_{i}", "f", camera.shape)
        color = None
        if f"keyframe_color_{i}" in file:
            color = file.array(f"keyframe_color_{i}", "u", (*camera.shape, 3)).astype(np.uint8)
        with file.values_of(f"keyframe_T_world_camera of {names[i]}"):
            T_world_camera = as_pose(poses[i])
        place = T_world_camera, camera, float(stamps[i])
        own = read_evidence(file, f"keyframe_{i}_", camera)
        keyframes.append(StoredKeyframe(id, names[i], depth_m, *place, color, own))
    next_id = file.integers("next_id", (), 0, 2**53).item()
    if len(set(ids.tolist())) < n or not all(0 <= id < next_id for id in ids.tolist()):
        raise MapFileError(f"{path}: damaged: keyframe_ids are not valid below next_id, or not distinct")
    config, noise = _config(path, file), read_stored(file, _NOISE)
    # Maps of earlier versions saved the default sensor, whatever their noise.
    config = replace(config, sensor=describing(noise, config.sensor))
    settled = file.scalar("settled", "b") if "settled" in file else True  # earlier versions did not save it
    up = _up(path, file, keyframes)
    return MapHeader(config, noise, keyframes, next_id, settled, up, read_promise(file))


def read_bricks(path: Path, file: NpzFile) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The coordinates of a map's bricks, (n, 3), and their beliefs, log-odds (n, 512)."""
    bricks = read_places(path, file, "bricks")
    return bricks, file.array("belief", "f", (len(bricks), VOXELS)).astype(np.float32)


def read_places(path: Path, file: NpzFile, name: str) -> NDArray[np.int32]:
    """An array of bricks, (n, 3), each of which a map can hold, and none twice."""
    span = SparseTopology.HALF_SPAN
    bricks = file.integers(name, (None, 3), -span, span - 1).astype(np.int32)
    if len(np.unique(grid_keys(bricks))) < len(bricks):
        raise MapFileError(f"{path}: damaged: {name} holds a brick twice")
    return bricks


def _up(path: Path, file: NpzFile, keyframes: list[StoredKeyframe]) -> Up | None:
    if "up" not in file:  # a file of an earlier version
        return up_of(keyframes[0].T_world_camera, keyframes[0].camera.up) if keyframes else None
    name = file.scalar("up", "U")
    if name not in ("", *UP_NAMES):
        raise MapFileError(f"{path}: damaged: up is {name!r}")
    return up_from_name(name) if name else None


def _config(path: Path, file: NpzFile) -> Config:
    try:
        return from_dict(Config, parse_yaml(file.scalar("config", "U")), f"{path}: config", of_map=True)
    except ValueError as error:
        raise MapFileError(f"{path}: damaged: config cannot be read: {said(error)}") from error


_PROMISE = ("levels", "bound", "held_least", "held_most", "lost_m")


def promise_arrays(promise: "FreePromise") -> dict[str, NDArray[Any]]:
    """The bounds for the levels of free space, as arrays by name."""
    arrays = {f"promise_{name}": getattr(promise, name) for name in _PROMISE}
    return {**arrays, "promise_blocks": np.asarray(promise.blocks)}


def read_promise(file: NpzFile) -> "FreePromise | None":
    """The bounds that :func:`promise_arrays` saved; None in files of earlier versions, which have none."""
    if "promise_levels" not in file:
        return None
    levels = file.array("promise_levels", "f", (None,))
    others = {name: file.array(f"promise_{name}", "f", (len(levels),)) for name in _PROMISE[1:]}
    return free.FreePromise(levels=levels, **others, blocks=file.scalar("promise_blocks", "iu"))


def evidence_arrays(own: OwnEvidence, prefix: str) -> dict[str, NDArray[Any]]:
    """Arrays of the evidence that a keyframe states; none if it states nothing."""
    arrays = {} if own.noise is None else stored_arrays(own.noise, prefix + _NOISE)
    if own.sigma_m is not None:
        arrays[f"{prefix}sigma_m"] = own.sigma_m
    if own.no_return is not None:
        arrays[f"{prefix}no_return"] = own.no_return
    if own.pose_covariance is not None:
        arrays[f"{prefix}pose_covariance"] = own.pose_covariance
    return arrays | {f"{prefix}image_{name}": image for name, image in own.images.items()}


def read_evidence(file: NpzFile, prefix: str, camera: Camera) -> OwnEvidence:
    """Evidence of a keyframe that :func:`evidence_arrays` has saved."""
    noise = read_stored(file, prefix + _NOISE) if is_stored(file, prefix + _NOISE) else None
    sigma_m = None
    if f"{prefix}sigma_m" in file:
        sigma_m = file.array(f"{prefix}sigma_m", "f", camera.shape).astype(np.float32)
    no_return = None
    if f"{prefix}no_return" in file:
        no_return = file.array(f"{prefix}no_return", "bf", camera.shape)
    covariance = None
    if f"{prefix}pose_covariance" in file:
        with file.values_of(f"{prefix}pose_covariance"):
            covariance = checked_covariance(file.array(f"{prefix}pose_covariance", "f", (6, 6)))
    images = {}
    for made in pixel_layers().values():
        if (stored := f"{prefix}image_{made.image}") in file:
            shape = (*camera.shape, *([made.channels] * (made.channels > 1)))
            images[made.image] = file.array(stored, "u", shape).astype(np.uint8)
    return OwnEvidence(noise, sigma_m, no_return, covariance, images)


def camera_arrays(cameras: Sequence[Camera]) -> dict[str, NDArray]:
    """The cameras of keyframes as arrays by name. Raises MapFileError for one that cannot be saved."""
    if all(isinstance(camera, PinholeCamera) for camera in cameras):
        rows = [camera.row for camera in cameras if isinstance(camera, PinholeCamera)]
        return {_CAMERA_ROWS: np.array(rows).reshape(-1, _CAMERA_ROW)}
    distinct = {camera: number for number, camera in enumerate(dict.fromkeys(cameras))}
    arrays: dict[str, NDArray] = {NUMBERS: np.array([distinct[camera] for camera in cameras], np.int64)}
    for camera, number in distinct.items():
        arrays |= stored_arrays(camera, f"camera_{number}_", "a keyframe's camera")
    return arrays


def read_cameras(file: NpzFile, keyframes: int) -> list[Camera]:
    """The cameras that :func:`camera_arrays` has saved, one for each keyframe. Raises the file's error."""
    if NUMBERS not in file:
        with file.values_of(_CAMERA_ROWS):
            return [
                PinholeCamera.of_row(row) for row in file.array(_CAMERA_ROWS, "fi", (keyframes, _CAMERA_ROW))
            ]
    numbers = file.array(NUMBERS, "i", (keyframes,)).tolist()
    distinct = {number: read_stored(file, f"camera_{number}_") for number in dict.fromkeys(numbers)}
    return [distinct[number] for number in numbers]
