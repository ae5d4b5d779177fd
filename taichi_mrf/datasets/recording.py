"""A recording in files: the reader behind every folder format.

A format only lists the files of each frame; a frame is checked here, when it is read.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, StatedSensor, Table
from taichi_mrf.datasets.color_camera import ColorCamera, without_black
from taichi_mrf.datasets.confidence import Confidence
from taichi_mrf.datasets.depth_scale import PLAUSIBLE_MEDIAN_M, USUAL, Evidence, gather
from taichi_mrf.datasets.images import (
    first_size,
    look_at_depth,
    note_of_largest,
    read_color,
    read_depth,
    read_grey,
    read_levels,
    stated_size,
)
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.turned import of_image_size
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import is_file, is_folder
from taichi_mrf.voxels.layers import FromPixels, pixel_layers

ASKED = "--depth-scale"
"""Origin of a scale that the caller gives."""

LOST = "tracking was lost"
"""Reason why a frame without a pose is left out."""

_LOOKED_AT = 4
"""Images of which the kind and the share of the largest value are found when a recording is opened."""


@dataclass(frozen=True)
class RecordedFrame(Row):
    """The files of one frame. ``camera`` is its own, None for the recording's."""

    depth_file: Path
    color_file: Path | None = None
    confidence_file: Path | None = None
    camera: PinholeCamera | None = None


@dataclass
class Recording(Table[RecordedFrame]):
    """Frames in files, read on request.

    ``steps_per_metre`` is the scale of the depth images and ``scale_source`` where it comes from. Unless it
    is the caller's or ``scale_stated`` by a file, :meth:`check_scale` may find another. If it is
    ``scale_assumed``, not even the format says so. ``color_camera`` took the colour images, unless they are
    registered to depth. ``layer_images`` are the folders of images beside depth that layers of voxels follow
    from, each with an image NAME.png for the frame NAME.
    """

    camera: PinholeCamera
    steps_per_metre: float = 1000.0
    scale_source: str = "the format's"
    scale_assumed: bool = False
    scale_stated: bool = False
    color: bool = True
    color_camera: ColorCamera | None = None
    layer_images: Mapping[Path, FromPixels] = field(default_factory=dict)
    scale_notes: list[str] = field(default_factory=list)
    """Notes of the last check of the scale."""

    @property
    def stated(self) -> StatedSensor:
        """Sigma that the confidence is relative to, which only some folders hold."""
        return replace(super().stated, pixel_sigma=any(row.confidence_file is not None for row in self.rows))

    def misfit(self) -> str | None:
        """The first depth image whose header says another size than the camera's."""
        for row in self.rows:
            camera, size = row.camera or self.camera, stated_size(row.depth_file)
            if size is not None and size != (camera.width, camera.height):
                return (
                    f"frame {row.name}: {row.depth_file}: the image has {size[0]} x {size[1]} pixels, the "
                    f"camera {camera.width} x {camera.height}; --skip-bad-frames leaves such frames out"
                )
        return None

    def load(self, index: int, row: RecordedFrame, T_world_camera: Pose) -> Frame:
        """Read the images of one frame, which must have the camera's size."""
        camera = row.camera or self.camera
        color = sigma_m = None
        depth_m = read_depth(row.depth_file, self.steps_per_metre, camera)
        if self.color and row.color_file is not None:
            color = self._read_color(row.color_file, depth_m, camera)
        if self.confidence is not None and row.confidence_file is not None:
            sigma_m = self._read_sigma(row.confidence_file, depth_m, self.confidence, camera)
        images = {
            made.image: read_levels(folder / f"{row.name}.png", made.channels, camera)
            for folder, made in self.layer_images.items()
        }
        return Frame(depth_m, T_world_camera, camera, row.stamp, row.name, color, sigma_m, images=images)

    def _read_sigma(
        self, path: Path, depth_m: NDArray[np.float32], confidence: Confidence, camera: PinholeCamera
    ) -> NDArray[np.float32]:
        """The sigma of each pixel, from an image of its confidence. Raises DatasetError."""
        levels = read_grey(path)
        with naming(path):
            return confidence.sigma_m(levels, depth_m, camera)

    def _read_color(
        self, path: Path, depth_m: NDArray[np.float32], camera: PinholeCamera
    ) -> NDArray[np.uint8]:
        """The colours of the depth image's pixels. Raises DatasetError."""
        if self.color_camera is None:
            return without_black(_of_size(read_color(path), path, camera))
        color = read_color(path, self.color_camera.camera)
        return self.color_camera.registered(color, depth_m, camera)

    def check_scale(self, pose: Callable[[int], Pose] | None) -> list[str]:
        """Compare neighbouring frames at their poses, and note which scale is used and why. A scale of the
        format is replaced by a usual one with which neighbouring frames agree clearly better; one that a file
        or the caller gives is kept, and a note says that another would agree better."""
        apart = max(1, len(self.rows) // _LOOKED_AT)
        looked = [
            look_at_depth(frame.depth_file, frame.camera or self.camera)
            for frame in self.rows[::apart][:_LOOKED_AT]
        ]
        if looked and looked[0][0] and self.scale_source != ASKED and not self.scale_stated:
            self.steps_per_metre, self.scale_source = 1.0, "metres, as the images hold floats"
        own = self.steps_per_metre
        found = gather(
            len(self.rows) if pose is not None else min(1, len(self.rows)),
            pose or self.pose,
            lambda index: read_depth(self.rows[index].depth_file, 1.0, self.camera),
            self.camera,
            tuple(dict.fromkeys((own, *USUAL))),
        )
        notes = note_of_largest([share for _, share in looked])
        better = found.better_than(own)
        is_given = self.scale_stated or self.scale_source == ASKED
        if better is not None and not is_given:
            self.steps_per_metre = better
            notes.append(
                f"depth: {better:g} steps per metre, found by comparing neighbouring frames at the recorded "
                f"poses: their depths differ by {found.disagreement[better]:.1%}, by "
                f"{found.disagreement[own]:.1%} at {own:g} ({self.scale_source}); --depth-scale sets another"
            )
        elif better is not None:
            notes.append(
                f"depth: {own:g} steps per metre ({self.scale_source}) do not fit the recorded poses: "
                f"neighbouring frames differ by {found.disagreement[own]:.1%}, at {better:g} by "
                f"{found.disagreement[better]:.1%}; check --depth-scale"
            )
        elif self.scale_assumed:
            notes.append(
                f"depth: {own:g} steps per metre ({self.scale_source}){_evidence(found, own)}; "
                "--depth-scale sets another"
            )
        median_m = None if found.median is None else found.median / self.steps_per_metre
        if median_m is not None and not PLAUSIBLE_MEDIAN_M[0] <= median_m <= PLAUSIBLE_MEDIAN_M[1]:
            notes.append(
                f"depth: {self.steps_per_metre:g} steps per metre make a median depth of {median_m:.3g} m, "
                "which is not plausible; check --depth-scale"
            )
        self.scale_notes = notes
        return notes


def recording(
    folder: Path,
    options: ReadOptions,
    camera: PinholeCamera,
    rows: Sequence[RecordedFrame],
    steps_per_metre: float,
    scale_source: str,
    notes: Sequence[str] = (),
    listed: int | None = None,
    why_dropped: str = "",
    **more: Any,
) -> Recording:
    """The recording in a folder. A scale that the user gives replaces the format's. Of the images that were
    ``listed`` some have no row: a note says ``why_dropped``, unless the caller has said so."""
    dropped = 0 if listed is None else listed - len(rows)
    said = [f"{dropped} of {listed} images dropped: {why_dropped}"] if dropped and why_dropped else []
    if turned := options.conventions.turned:
        size = first_size(row.depth_file for row in rows)
        camera = of_image_size(camera, size, turned)
        rows = [replace(row, camera=row.camera and of_image_size(row.camera, size, turned)) for row in rows]
    beside = {folder / made.image: made for made in pixel_layers().values() if made.image != "color"}
    beside = {place: made for place, made in beside.items() if is_folder(place)}
    said += [f"{made.image}: from the images in {place.name}/" for place, made in beside.items()]
    return Recording(
        folder.name,
        camera,
        [*notes, *said],
        dropped,
        rows=rows,
        steps_per_metre=options.depth_scale or steps_per_metre,
        scale_source=ASKED if options.depth_scale else scale_source,
        color=options.color,
        layer_images=beside,
        **more,
    )


def first_file(candidates: Iterable[Path]) -> Path | None:
    """The first of some files that is there."""
    return next((path for path in candidates if path.is_file()), None)


def natural(path: Path) -> tuple[list[tuple[int, str]], str]:
    """A key that orders names by the numbers in them: scan-9 before scan-10."""
    words = re.split(r"(\d+)", path.stem)
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words], path.name


def number_in(name: str) -> int | None:
    """The last number in a name, None if there is none."""
    found = re.findall(r"\d+", name)
    return int(found[-1]) if found else None


def beside(folder: Path, name: str) -> Path:
    """A file that a list in a folder names; of a path of another computer that with the same end, if any."""
    path = folder / name
    try:
        parts = PureWindowsPath(name).parts
        if len(parts) < 2 or is_file(path):
            return path
        return first_file(folder.joinpath(*parts[first:]) for first in (0, -2)) or path
    except OSError:  # a name that is too long
        return path


def _of_size(color: NDArray[np.uint8], path: Path, camera: PinholeCamera) -> NDArray[np.uint8]:
    """A registered colour image with the depth image's pixels. Raises DatasetError for another view."""
    (height, width), (rows, columns) = camera.shape, color.shape[:2]
    if (rows, columns) == (height, width):
        return color
    if columns < width or abs(columns * height - rows * width) > 0.01 * rows * width:
        raise DatasetError(
            f"{path}: the colour image has {columns} x {rows} pixels, depth {width} x {height}, which is not "
            "the same view; without --color only depth is read"
        )
    return cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def _evidence(found: Evidence, steps_per_metre: float) -> str:
    """Evidence for a scale, in words."""
    words = []
    if found.median is not None:
        words.append(f"the median depth is {found.median / steps_per_metre:.2f} m")
    if steps_per_metre in found.disagreement:
        words.append(
            f"neighbouring frames differ by {found.disagreement[steps_per_metre]:.1%} at the recorded poses"
        )
    return f": {', '.join(words)}" if words else ""
