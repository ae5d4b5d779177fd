"""A sequence of frames in figures: its length, camera, path and depth range, from a few of its frames; and
whether it has colour images that a command does not read."""

from dataclasses import dataclass

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.registry import open_dataset
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import DatasetError, FrameError, TaichiMRFError
from taichi_mrf.sensor.camera import Camera

UNUSED_COLOR = "color: there are colour images, which are not used; --color gives their colours to the map"


def note_unused_color(dataset: Dataset, source: str, reading: SourceFlags) -> None:
    """Add UNUSED_COLOR to the notes of a dataset that was opened without colours if the first frame of its
    source has some. A source without end is not looked at: it cannot be opened twice."""
    if not dataset.endless and _has_color(source, reading):
        dataset.notes.append(UNUSED_COLOR)


def _has_color(source: str, reading: SourceFlags) -> bool:
    try:
        return open_dataset(source, color=True, **reading.keywords()).read(0).color is not None
    except TaichiMRFError:  # of the colours alone: the dataset without them is open
        return False


LOOKED_AT = 8
"""Frames, evenly spread, that a summary reads."""


@dataclass(frozen=True)
class Summary:
    """``frames`` is None for a source without end. ``depth_range`` are the 1st and 99th percentile of the
    depths in metres of the frames that were read, ``measured`` the share of their pixels that have one;
    ``centre_range`` the lowest and the highest camera position in metres. The three are None if no
    frame could be read; ``problem`` says why.
    """

    frames: int | None
    camera: Camera
    seconds: float | None
    depth_range: tuple[float, float] | None
    measured: float | None
    centre_range: tuple[tuple[float, ...], tuple[float, ...]] | None
    problem: str | None
    usable: bool
    """True if any of the frames could be read; otherwise there is nothing to map."""


def summarise(dataset: Dataset) -> Summary:
    """Read a few frames of a sequence. Broken ones are left out; the problem of the first is kept."""
    count = 1 if dataset.endless else len(dataset)
    indices = np.unique(np.linspace(0, count - 1, min(count, LOOKED_AT)).round().astype(int))
    depths, centres, stamps, problem = [], [], [], None
    measured = pixels = 0
    for index in indices:
        try:
            frame = dataset.read(int(index))
        except FrameError as error:
            problem = problem or str(error)
            continue
        except DatasetError as error:
            problem = problem or str(error)
            break
        seen = frame.depth_m[frame.depth_m > 0]
        depths.append(seen)
        measured, pixels = measured + seen.size, pixels + frame.depth_m.size
        centres.append(frame.T_world_camera[:3, 3])
        stamps.append(frame.stamp)
    problem = problem or dataset.misfit()
    values, places = np.concatenate(depths) if depths else np.empty(0), np.array(centres)
    low_high = np.percentile(values, [1, 99]) if values.size else None
    return Summary(
        frames=None if dataset.endless else count,
        camera=dataset.camera,
        seconds=float(stamps[-1] - stamps[0]) if len(stamps) > 1 else None,
        depth_range=None if low_high is None else (float(low_high[0]), float(low_high[1])),
        measured=measured / pixels if pixels else None,
        centre_range=(tuple(places.min(0).tolist()), tuple(places.max(0).tolist())) if centres else None,
        problem=problem,
        usable=bool(centres),
    )
