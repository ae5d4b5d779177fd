"""What maps on disk have in common, whatever the mapping method: one .npz file that NumPy alone can read.

Its header says which format and which method it is of, with which parameters and which noise, and holds
the keyframes' images and poses. The bricks and what they hold are each method's own matter.
"""

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import Config, Method, to_yaml
from taichi_mrf.config_values import from_dict
from taichi_mrf.errors import MapFileError, TaichiMRFError
from taichi_mrf.poses import Pose
from taichi_mrf.sensor.noise import NoiseModel, PatchNoise, PolynomialNoise

FORMAT = 1

CLASSES: dict[Method, str] = {"mrf": "MRFMap", "log_odds": "LogOddsMap", "visibility": "VisibilityMap"}
"""Who reads a map of each method."""

MapFile = np.lib.npyio.NpzFile


@dataclass(frozen=True)
class StoredKeyframe:
    """A keyframe's number, name, (H, W) axial depth in metres, pose and camera."""

    id: int
    name: str
    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: PinholeCamera


@dataclass(frozen=True)
class MapHeader:
    """What every map has; ``config.method`` says of which method it is."""

    config: Config
    noise: NoiseModel
    keyframes: list[StoredKeyframe]
    next_id: int

    def arrays(self) -> dict[str, NDArray]:
        """The header as arrays by name. Raises MapFileError for a noise model that cannot be saved."""
        keyframes = self.keyframes
        arrays: dict[str, NDArray] = {
            "format": np.asarray(FORMAT),
            "method": np.asarray(self.config.method),
            "config": np.asarray(to_yaml(self.config)),
            "keyframe_ids": np.array([k.id for k in keyframes], np.int64),
            "keyframe_names": np.array([k.name for k in keyframes], np.str_),
            "keyframe_T_world_camera": np.array([k.T_world_camera for k in keyframes]).reshape(-1, 4, 4),
            "keyframe_cameras": np.array([_camera_row(k.camera) for k in keyframes]).reshape(-1, 6),
            "next_id": np.asarray(self.next_id),
            **_noise_arrays(self.noise),
        }
        for number, keyframe in enumerate(keyframes):
            arrays[f"keyframe_depth_{number}"] = keyframe.depth_m
        return arrays


@contextmanager
def open_map_file(path: Path, method: Method | None = None) -> Iterator[MapFile]:
    """The arrays of a map's file, by name.

    Raises MapFileError naming the file and what is wrong with it, also for what goes wrong inside the
    ``with`` block, and if the map is of another ``method`` (None takes all).
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if "format" not in file:
                raise MapFileError(f"{path}: not a map of taichi_mrf")
            if int(file["format"]) != FORMAT:
                raise MapFileError(
                    f"{path}: written in format {int(file['format'])}; this version reads format {FORMAT}"
                )
            found = method_of(file)
            if found not in CLASSES:
                raise MapFileError(f"{path}: a map of the method '{found}', which this version does not know")
            if method is not None and found != method:
                raise MapFileError(
                    f"{path}: a map of the method '{found}', which {CLASSES[found]}.load reads, "
                    f"not {CLASSES[method]}.load"
                )
            yield file
    except MapFileError:
        raise
    except FileNotFoundError as error:
        raise MapFileError(f"{path}: there is no such file") from error
    except KeyError as error:
        raise MapFileError(f"{path}: damaged: it lacks {error}") from error
    except TaichiMRFError as error:
        raise MapFileError(f"{path}: {error}") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, yaml.YAMLError) as error:
        raise MapFileError(f"{path}: not a readable map: {error}") from error


def method_of(file: MapFile) -> Method:
    """The mapping method of a map's file; the first maps did not say it, because there was only one."""
    return str(file["method"]) if "method" in file else "mrf"  # type: ignore[return-value]


def read_header(path: Path, file: MapFile) -> MapHeader:
    """The header of an open file."""
    keyframes = [
        StoredKeyframe(int(id), str(name), file[f"keyframe_depth_{i}"], T, _camera(row))
        for i, (id, name, T, row) in enumerate(
            zip(
                file["keyframe_ids"],
                file["keyframe_names"],
                file["keyframe_T_world_camera"],
                file["keyframe_cameras"],
                strict=True,
            )
        )
    ]
    config = from_dict(Config, yaml.safe_load(str(file["config"])), str(path))
    return MapHeader(config, _noise(file), keyframes, int(file["next_id"]))


def _camera_row(camera: PinholeCamera) -> list[float]:
    return [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]


def _camera(row: NDArray[np.float64]) -> PinholeCamera:
    width, height, *rest = row.tolist()
    return PinholeCamera(int(width), int(height), *rest)


def _noise_arrays(noise: NoiseModel) -> dict[str, NDArray]:
    if isinstance(noise, PatchNoise):
        return {
            "noise_sigma": noise.sigma,
            "noise_bias": noise.bias,
            "noise_patch": np.asarray(noise.patch),
            "noise_camera": np.asarray(_camera_row(noise.camera)),
        }
    if isinstance(noise, PolynomialNoise):
        return {"noise_sigma": noise.sigma, "noise_bias": noise.bias}
    raise MapFileError(f"a noise model of type {type(noise).__name__} cannot be saved")


def _noise(file: MapFile) -> NoiseModel:
    if "noise_patch" in file:
        camera = _camera(file["noise_camera"])
        return PatchNoise(file["noise_sigma"], file["noise_bias"], int(file["noise_patch"]), camera)
    return PolynomialNoise(file["noise_sigma"][0], file["noise_bias"][0])
