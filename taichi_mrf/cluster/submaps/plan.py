"""Division of a long sequence into submaps: the space that each owns, and the keyframes that it needs.

The plane is cut into square columns, aligned to chunks of 64^3 voxels and unbounded in z. A submap owns the
bricks in its column, its core, and has every keyframe with a ray in there, with all of its rays: all
messages to the core are computed in one place. The rest of those rays lies in the cores of other submaps.

The common input of a run's tasks (source, parameters and plan) is one JSON file in its folder.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.config.text import differences
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.errors import ConfigError, MapFileError, said
from taichi_mrf.geometry.up import Z_UP, Up
from taichi_mrf.system.atomic import write_text
from taichi_mrf.voxels.layers import FIRST, SURFACE, pixel_layers
from taichi_mrf.voxels.layout import CHUNK, CHUNK_VOXELS

Cell = tuple[int, int]
"""A column of the grid: its place along x and y."""

PLAN_FILE = "plan.json"

FREE_TO_DIFFER = ("runtime.", "volume.memory_limit_gb")
"""Parameters (or groups) that may differ from one part of a run to the next."""


@dataclass(frozen=True)
class SeenFrame:
    """Part of a keyframe that the plan needs: its index in the dataset, where the camera was, in metres, and
    the chunks (n, 3) that its rays cross; ``up`` is the world axis that is up in its image, ``images`` are
    the names of its images beside depth and colour."""

    index: int
    centre_m: tuple[float, float, float]
    chunks: NDArray[np.int32]
    up: Up = Z_UP
    images: tuple[str, ...] = ()


@dataclass(frozen=True)
class Submap:
    """One task: the column ``cell`` of the grid, and the dataset indices of the keyframes that see it."""

    cell: Cell
    keyframes: tuple[int, ...]


@dataclass(frozen=True)
class Plan:
    """All submaps of a sequence, in the order of their cells; a column is ``chunks_across`` chunks wide."""

    chunks_across: int
    submaps: tuple[Submap, ...]

    def cells_of(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """The columns that bricks (n, 3) lie in, (n, 2)."""
        return cells_of_chunks(bricks // CHUNK, self.chunks_across)

    def is_core(self, number: int, bricks: NDArray[np.int32]) -> NDArray[np.bool_]:
        """True for each of the bricks (n, 3) that a submap owns, (n,)."""
        return (self.cells_of(bricks) == self.submaps[number].cell).all(axis=1)

    def neighbours(self, number: int) -> dict[int, tuple[int, ...]]:
        """The submaps that have keyframes in common with this one, and the indices of these."""
        own = set(self.submaps[number].keyframes)
        common = {
            other: tuple(sorted(own.intersection(submap.keyframes)))
            for other, submap in enumerate(self.submaps)
            if other != number
        }
        return {other: indices for other, indices in common.items() if indices}

    @property
    def overlap(self) -> float:
        """Mean number of submaps that a keyframe belongs to."""
        distinct = {index for submap in self.submaps for index in submap.keyframes}
        return sum(len(submap.keyframes) for submap in self.submaps) / max(1, len(distinct))


def cells_of_chunks(chunks: NDArray[np.int32], chunks_across: int) -> NDArray[np.int32]:
    """The columns that chunks (n, 3) lie in, (n, 2)."""
    return chunks[:, :2] // chunks_across


def chunks_for(submap_size: float, voxel_size: float) -> int:
    """Width in chunks of a column of at least ``submap_size`` metres.

    Raises ConfigError for a size that is not a positive number of metres.
    """
    if not (math.isfinite(submap_size) and submap_size > 0):
        raise ConfigError(f"--submap-size must be a positive number of metres, not {submap_size}")
    # A size that is a whole number of chunks up to rounding is that number.
    return max(1, math.ceil(submap_size / (voxel_size * CHUNK_VOXELS) - 1e-9))


def plan_submaps(keyframes: Sequence[SeenFrame], submap_size: float, voxel_size: float) -> Plan:
    """Cut the space that keyframes see into columns of ``submap_size`` metres, or the next whole number of
    chunks. Raises ConfigError for an impossible size."""
    chunks_across = chunks_for(submap_size, voxel_size)
    members: dict[Cell, list[int]] = {}
    for keyframe in keyframes:
        for x, y in np.unique(cells_of_chunks(keyframe.chunks, chunks_across), axis=0).tolist():
            members.setdefault((x, y), []).append(keyframe.index)
    submaps = [Submap(cell, tuple(sorted(indices))) for cell, indices in sorted(members.items())]
    return Plan(chunks_across, tuple(submaps))


@dataclass(frozen=True)
class SourceFrames:
    """The frames to map: the arguments of ``open_dataset``, and every ``every``-th frame, at most ``limit``
    of them."""

    source: str
    reading: dict[str, Any]
    every: int = 1
    limit: int | None = None

    def open(self, color: bool = False) -> Dataset:
        """The recording, with its colour images or without. Raises DatasetError."""
        return open_dataset(self.source, color=color, **self.reading)


@dataclass(frozen=True)
class Job:
    """A sequence, how it is mapped, and how it is cut. ``skipped`` has the problem of each unreadable frame
    by name; ``centres_m`` are the camera centres of all keyframes, by their index in the dataset;
    ``up`` is the name of the world axis that is up, ``images`` are the names of the keyframes' images beside
    depth and colour; both empty in plans of earlier versions."""

    sequence: SourceFrames
    config: Config
    submap_size: float
    plan: Plan
    centres_m: dict[int, tuple[float, float, float]]
    skipped: dict[str, str]
    up: str = ""
    images: tuple[str, ...] = ()

    @property
    def layers(self) -> tuple[str, ...]:
        """The layers of the map beside log-odds."""
        images = {*self.images, "color"} if self.config.color else {*self.images}
        fed = (name for name, made in pixel_layers().items() if made.image in images)
        return (*fed, SURFACE, FIRST) if self.config.keep_surface else (*fed,)

    def write(self, folder: Path) -> None:
        """Write the plan's file. Raises MapFileError."""
        plan = {"chunks_across": self.plan.chunks_across, "submaps": [asdict(s) for s in self.plan.submaps]}
        content = {
            "sequence": asdict(self.sequence),
            "config": to_yaml(self.config),
            "submap_size": self.submap_size,
            "centres_m": self.centres_m,
            "skipped": self.skipped,
            "up": self.up,
            "images": self.images,
            "plan": plan,
        }
        write_text(folder / PLAN_FILE, json.dumps(content) + "\n")

    @staticmethod
    def read(folder: Path) -> "Job":
        """Read it back. Raises MapFileError."""
        path = folder / PLAN_FILE
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            plan = content["plan"]
            submaps = [Submap(tuple(s["cell"]), tuple(s["keyframes"])) for s in plan["submaps"]]
            return Job(
                _frames(content["sequence"]),
                from_dict(Config, parse_yaml(content["config"]), str(path), of_map=True),
                content["submap_size"],
                Plan(plan["chunks_across"], tuple(submaps)),
                {int(index): tuple(centre) for index, centre in content["centres_m"].items()},
                content["skipped"],
                content.get("up", ""),
                tuple(content.get("images", ())),
            )
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise MapFileError(f"{path}: not a readable plan of submaps: {said(error)}") from error

    def differences(self, sequence: SourceFrames, config: Config, submap_size: float) -> list[str]:
        """Names of the settings in which another run differs, as far as they change its result."""
        # As JSON, in which a tuple is a list.
        mine, other = (json.loads(json.dumps(asdict(each))) for each in (self.sequence, sequence))
        found = [name for name in mine if mine[name] != other[name]]
        found += [name for name in differences(self.config, config) if not name.startswith(FREE_TO_DIFFER)]
        return found + (["submap_size"] if submap_size != self.submap_size else [])


def _frames(stored: dict[str, Any]) -> SourceFrames:
    """The frames that a file names; of the robot's own body it has the fields."""
    reading = dict(stored["reading"])
    if body := reading.get("body"):
        boxes = tuple(tuple(box) for box in body["body_box"])
        reading["body"] = OwnBody(**{**body, "body_box": boxes})
    return SourceFrames(**{**stored, "reading": reading})
