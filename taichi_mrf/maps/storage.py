"""A map as one .npz file that NumPy alone can read.

What is stored is what a map is made of: its parameters, its bricks with their beliefs, and its
keyframes' images and poses. Messages are not: they are the largest part of a map in memory and follow
from the rest. Beliefs are, so that a loaded map answers queries at once.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import Config, to_yaml
from taichi_mrf.config_values import from_dict
from taichi_mrf.errors import MapFileError, TaichiMRFError
from taichi_mrf.export.atomic import write_npz
from taichi_mrf.poses import Pose
from taichi_mrf.sensor.noise import NoiseModel, PatchNoise, PolynomialNoise
from taichi_mrf.voxels.layout import VOXELS

FORMAT = 1


@dataclass(frozen=True)
class StoredKeyframe:
    """A keyframe's number, name, (H, W) axial depth in metres, pose and camera."""

    id: int
    name: str
    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: PinholeCamera


@dataclass(frozen=True)
class MapContents:
    """All that makes a map. ``belief`` and ``evidence`` are (n, 512) log-odds of the ``bricks`` (n, 3);
    ``frozen_owners`` (n,) counts the frozen keyframes that want each brick."""

    config: Config
    noise: NoiseModel
    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    evidence: NDArray[np.float32] | None
    frozen_owners: NDArray[np.int32]
    frozen_crossed: NDArray[np.int32]
    frozen: dict[int, str]
    keyframes: list[StoredKeyframe]
    next_id: int


def write_contents(path: Path, contents: MapContents) -> None:
    """Write a map beside its place first, then into it. Raises MapFileError."""
    keyframes = contents.keyframes
    arrays: dict[str, NDArray] = {
        "format": np.asarray(FORMAT),
        "config": np.asarray(to_yaml(contents.config)),
        "bricks": contents.bricks,
        "belief": contents.belief,
        "frozen_owners": contents.frozen_owners,
        "frozen_crossed": contents.frozen_crossed,
        "frozen_ids": np.array(list(contents.frozen), np.int64),
        "frozen_names": np.array(list(contents.frozen.values()), np.str_),
        "keyframe_ids": np.array([k.id for k in keyframes], np.int64),
        "keyframe_names": np.array([k.name for k in keyframes], np.str_),
        "keyframe_T_world_camera": np.array([k.T_world_camera for k in keyframes]).reshape(-1, 4, 4),
        "keyframe_cameras": np.array([_camera_row(k.camera) for k in keyframes]).reshape(-1, 6),
        "next_id": np.asarray(contents.next_id),
        **_noise_arrays(contents.noise),
    }
    if contents.evidence is not None:
        arrays["evidence"] = contents.evidence
    for number, keyframe in enumerate(keyframes):
        arrays[f"keyframe_depth_{number}"] = keyframe.depth_m
    write_npz(path, arrays)


def read_contents(path: Path) -> MapContents:
    """Read a map back. Raises MapFileError naming the file and what is wrong with it."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if "format" not in file:
                raise MapFileError(f"{path}: not a map of taichi_mrf")
            if int(file["format"]) != FORMAT:
                raise MapFileError(
                    f"{path}: written in format {int(file['format'])}; this version reads format {FORMAT}"
                )
            contents = _contents(path, file)
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
    n = len(contents.bricks)
    shapes = [contents.belief.shape == (n, VOXELS), contents.bricks.shape == (n, 3)]
    shapes += [contents.frozen_owners.shape == (n,)]
    if contents.evidence is not None:
        shapes.append(contents.evidence.shape == (n, VOXELS))
    if not all(shapes):
        raise MapFileError(f"{path}: damaged: its bricks and their voxels do not match")
    return contents


def _contents(path: Path, file: "np.lib.npyio.NpzFile") -> MapContents:
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
    frozen = zip(file["frozen_ids"].tolist(), file["frozen_names"].tolist(), strict=True)
    return MapContents(
        from_dict(Config, yaml.safe_load(str(file["config"])), str(path)),
        _noise(file),
        file["bricks"],
        file["belief"],
        file.get("evidence"),
        file["frozen_owners"],
        file["frozen_crossed"],
        dict(frozen),
        keyframes,
        int(file["next_id"]),
    )


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


def _noise(file: "np.lib.npyio.NpzFile") -> NoiseModel:
    if "noise_patch" in file:
        camera = _camera(file["noise_camera"])
        return PatchNoise(file["noise_sigma"], file["noise_bias"], int(file["noise_patch"]), camera)
    return PolynomialNoise(file["noise_sigma"][0], file["noise_bias"][0])
