"""The file that a submap's task writes in each round, for the next round and the merge."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import from_dict
from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import NpzFile, open_npz
from taichi_mrf.voxels.layers import LAYERS, SURFACE, BrickValues, Layers
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.topology import SparseTopology

Bricks = NDArray[np.int32]
LogOdds = NDArray[np.float32]
Halo = tuple[Bricks, LogOdds]
"""Bricks (n, 3) with log-odds of their voxels, (n, 512)."""


@dataclass(frozen=True)
class SubmapReport:
    """Report on a task. ``core_bricks`` belong to the submap; ``free_bricks`` do too, but have no voxels;
    ``halo_bricks`` are those of other submaps whose evidence it was given; ``surface_bricks`` are its own
    bricks in which keyframes contribute to the surface, if a surface is wanted. ``moved`` is the share of the
    core's voxels whose probability has changed by more than 0.01 since the round before, and ``halo_moved``
    the same for the evidence sent to others; None in the first round."""

    submap: int
    round: int
    keyframes: int
    rays: int
    core_bricks: int
    free_bricks: int
    halo_bricks: int
    seconds: float
    inferring_seconds: float
    map_mb: float
    peak_memory_mb: float | None
    moved: float | None = None
    halo_moved: float | None = None
    surface_bricks: int = 0

    @property
    def has_nothing(self) -> bool:
        """True if rays only pass through: there is nothing to infer."""
        return not self.core_bricks and not self.surface_bricks


@dataclass(frozen=True)
class RoundResult:
    """The result of a submap: the beliefs in the bricks that it owns, the bricks that it owns in which rays
    met no surface, and the evidence for each neighbour; and those other ``layers`` of its space that are
    wanted."""

    bricks: Bricks
    belief: LogOdds
    free_bricks: Bricks
    halos: Mapping[int, Halo]
    report: SubmapReport
    layers: Layers = field(default_factory=dict)


def round_path(folder: Path, round: int, submap: int) -> Path:
    """The file of a submap and round."""
    return folder / f"round-{round:03d}" / f"submap-{submap:05d}.npz"


def write_round(path: Path, result: RoundResult) -> None:
    """Write a result beside its place, then into it. Raises MapFileError."""
    arrays: dict[str, NDArray] = {
        "bricks": result.bricks,
        "belief": result.belief,
        "free_bricks": result.free_bricks,
        "report": np.asarray(json.dumps(asdict(result.report))),
    }
    for name, found in result.layers.items():
        arrays[f"{name}_bricks"], arrays[f"{name}_values"] = found.bricks, found.values
    for other, (bricks, evidence) in result.halos.items():
        arrays[f"halo_{other}_bricks"], arrays[f"halo_{other}_evidence"] = bricks, evidence
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MapFileError(f"{path.parent}: cannot be made: {error.strerror or error}") from error
    write_npz(path, arrays)


@contextmanager
def _opened(path: Path) -> Iterator[NpzFile]:
    """The arrays by name, each read when it is asked for. Raises MapFileError."""
    with open_npz(path, MapFileError, "a readable round of a submap") as file:
        yield file


def _bricks(file: NpzFile, name: str) -> Bricks:
    span = SparseTopology.HALF_SPAN
    return file.integers(name, (None, 3), -span, span - 1)


def _halo(file: NpzFile, bricks: str, log_odds: str) -> Halo:
    where = _bricks(file, bricks)
    return where, file.array(log_odds, "f", (len(where), VOXELS))


def read_report(path: Path) -> SubmapReport:
    """Only the report."""
    with _opened(path) as file:
        try:
            return from_dict(SubmapReport, json.loads(file.scalar("report", "U")), str(path))
        except (ValueError, TypeError, ConfigError) as error:
            raise MapFileError(f"{path}: damaged: its report cannot be read: {error}") from error


def read_halo(path: Path, listener: int) -> Halo | None:
    """Only the evidence for one neighbour; None if there is none."""
    with _opened(path) as file:
        if f"halo_{listener}_bricks" not in file:
            return None
        return _halo(file, f"halo_{listener}_bricks", f"halo_{listener}_evidence")


def read_places(path: Path) -> list[Bricks]:
    """Only where the core is: its bricks, those without voxels, and those in which the surface was measured,
    if that is wanted."""
    with _opened(path) as file:
        names = ("bricks", "free_bricks", f"{SURFACE}_bricks")
        return [_bricks(file, name) for name in names if name in file]


def read_layer(path: Path, name: str) -> BrickValues:
    """One of the other layers of the core. Raises MapFileError if it was not made."""
    with _opened(path) as file:
        if f"{name}_bricks" not in file:
            raise MapFileError(
                f"{path}: holds no {name}: its round was not meant to be the last; --resume "
                "with more --rounds makes them"
            )
        bricks, layer = _bricks(file, f"{name}_bricks"), LAYERS[name]
        values = file.array(f"{name}_values", "iuf", (len(bricks), VOXELS, *layer.shape))
        return BrickValues(bricks, values.astype(layer.dtype))


def read_core(path: Path) -> tuple[Bricks, LogOdds, Bricks]:
    """The core: its bricks with their log-odds, and those without voxels."""
    with _opened(path) as file:
        return *_halo(file, "bricks", "belief"), _bricks(file, "free_bricks")
