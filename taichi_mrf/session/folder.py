"""Writing the folder of a run. Every run that has made a map leaves the same files, written here."""

import warnings
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from taichi_mrf.calibration.from_recording import LearntSigma, is_default_noise
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import commented_yaml
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.derived import reposed
from taichi_mrf.datasets.doctor.diagnosis import mistakes
from taichi_mrf.datasets.recorded_noise import some_depths
from taichi_mrf.errors import CutShortError, FrameError
from taichi_mrf.evaluation.free_space import MOST_FRAMES, calibrate_free, spread_frames
from taichi_mrf.evaluation.held_out import HeldOutCheck, Render, check_held_out
from taichi_mrf.evaluation.noise_fit import CONTRADICTED, DOUBTED, NoiseCheck, check_noise, enough_of
from taichi_mrf.evaluation.pictures.run_pictures import write_pictures
from taichi_mrf.export.formats import export_map, export_note
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.export.ply import layers_at, photo_at, write_voxels
from taichi_mrf.export.trajectory import CAMERA_AXES, LIDAR_AXES, write_trajectory
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.methods.capabilities import window_of
from taichi_mrf.methods.chunked_part import in_chunks, render_chunked
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.files import (
    CONFIG_FILE,
    MAP_FILE,
    NOISE_FILE,
    REPORT_FILE,
    TRAJECTORY_FILE,
    VOXEL_FILE,
    WINDOW_FOLDER,
    remove_files_of_earlier_run,
)
from taichi_mrf.session.noise import contradicts, noise_notes, noise_report, sensor_yaml
from taichi_mrf.session.report import report_json, rounded, run_report, unfinished_report
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.memory import peak_memory_mb

_LARGER_THAN_MEMORY = (
    "The map is not in memory as a whole (volume.window_m): map_window.zarr holds its {} chunks, voxels.ply "
    "its voxels; there are no pictures."
)

_MOST_UNANSWERED = 0.5
"""A map that answers fewer of the held-out pixels makes its recording doubtful."""

PICTURED_FRAMES = 3
"""Held-out frames in the picture of measured and rendered depth, at most."""

Advance = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of its steps that are done, and how many there are."""


class Haste(Protocol):
    """Interface to ask if a run is to end with what it has, as after Ctrl-C."""

    def __call__(self) -> bool:
        """True if the run is to end."""
        ...

    def cutting_short(self) -> AbstractContextManager[None]:
        """A block in which CutShortError is raised as soon as it is; the block may be left at any point."""
        ...


class _NoHaste:
    def __call__(self) -> bool:
        return False

    def cutting_short(self) -> AbstractContextManager[None]:
        return nullcontext()


NO_HASTE: Haste = _NoHaste()


@dataclass
class RunFacts:
    """Facts of a run's report besides its result: the ``source`` as it was asked for, the parameters, the
    recording (None for a saved map), further entries (``choice``), the unreadable frames of the run that this
    one resumes, warnings to be listed as notes, and how sigma was learnt, if it was."""

    source: str
    config: Config
    dataset: Dataset | None
    choice: dict[str, Any] = field(default_factory=dict)
    skipped_before: dict[str, str] = field(default_factory=dict)
    warned: list[warnings.WarningMessage] = field(default_factory=list)
    learnt: LearntSigma | None = None

    def report(
        self,
        result: MappingResult,
        check: HeldOutCheck | None,
        noise: NoiseCheck | None = None,
        mistakes: Sequence[str] = (),
    ) -> dict[str, Any]:
        """The report of the finished run."""
        report = run_report(result, self.dataset, self.source, check)
        report["noise"] = noise_report(self.config.sensor, noise, self.learnt)
        swept_m = 0.0 if self.dataset is None else self.dataset.stated.swept_m
        report["notes"] += noise_notes(self.config.sensor, noise, self.learnt, mistakes, swept_m)
        told = (str(warning.message) for warning in self.warned)
        report["notes"] = list(dict.fromkeys([*report["notes"], *told]))
        report["skipped_frames"] = self.skipped_before | report["skipped_frames"]
        return report | self.choice

    def unfinished(self, result: MappingResult) -> dict[str, Any]:
        """The report of a run that is not finished."""
        return unfinished_report(result, self.dataset, self.source, self.skipped_before) | self.choice


def write_run(
    folder: Path,
    result: MappingResult,
    facts: RunFacts,
    *,
    check: bool = True,
    pictures: bool = True,
    haste: Haste = NO_HASTE,
    advance: Advance = lambda stage, done, total: None,
    mistakes_of: Callable[[Dataset], list[str]] = mistakes,
) -> tuple[dict[str, Any], list[Path]]:
    """Write all files of a run to a folder that exists: the map first, because the time went into it, the
    report last. With ``check`` the held-out frames are compared with the map, and the poses with the depth;
    with ``pictures`` it is drawn, if it is in memory as a whole. In ``haste`` all but the map, its parameters
    and the report is left out, as a note says, and the run counts as interrupted: resumed, it makes them.
    Files of an earlier run are removed.

    Returns the report and the paths; ``refused`` in the report is why the map is not to be used, of which
    ``mistakes_of`` the recording say what mends it. Raises MapFileError.
    """
    posed = facts.dataset
    if posed is not None and result.track is not None:
        posed = reposed(posed, result.track.poses(result.map))
    if check and posed is not None and not haste():
        _calibrate(result, posed, advance)
    written, occupied = _write_map(folder, result, facts.config, haste, advance)
    chunked = in_chunks(result.map)
    found, noise = None, None
    if check and posed is not None:
        render = None if chunked is None else partial(render_chunked, chunked)
        judged, pictured = enough_of(result.held_out), _spread(result.held_out, PICTURED_FRAMES)
        keep = {*judged, *pictured} if chunked is None else set()
        found = _check(result, posed, haste, advance, render, keep)
        if found is not None and chunked is None:
            advance("Noise", 0, 1)
            default = is_default_noise(posed, facts.config.sensor)
            frames = [found.kept[index][0] for index in judged if index in found.kept]
            noise = _check_noise(result, frames, haste, DOUBTED if default else CONTRADICTED)
        if not haste() and not result.interrupted:
            advance("Poses", 0, 1)
            with result.timed("checking"):
                result.check_steps()
    drawn: list[Path] = []
    # Computed before the pictures, which may be left half-way through the launch of a kernel.
    seen: list[str] = []
    unanswered = 0.0 if found is None else found.error.unanswered
    if posed is not None and (contradicts(noise) or unanswered > _MOST_UNANSWERED) and not haste():
        with result.timed("checking"):
            seen = mistakes_of(posed)
    report = facts.report(result, found, noise, seen)
    if seen and not contradicts(noise):
        share = f"{unanswered:.0%} of the held-out pixels have no answer in the map"
        report["notes"].append(f"{share}: {'; '.join(seen)}.")
    if occupied == 0:
        report["refused"] = _nothing_occupied(facts.config, posed)
        report["notes"].append(report["refused"])
    elif contradicts(noise) or seen:
        report["refused"] = next(note for note in reversed(report["notes"]) if "held-out" in note)
    if chunked is not None:
        report["notes"].append(_LARGER_THAN_MEMORY.format(len(chunked.chunks)))
    elif pictures:
        drawn = _write_pictures(folder, result, posed, found, haste, advance)
        written += drawn
    if facts.learnt is not None:
        write_text(folder / NOISE_FILE, sensor_yaml(facts.config.sensor, facts.source, facts.learnt))
        written.append(folder / NOISE_FILE)
    if haste():
        report["interrupted"] = True
        report["notes"] += _left_out(
            voxels=occupied is None, check=check and found is None, pictures=pictures and not drawn
        )
    remove_files_of_earlier_run(folder, written)
    report |= {"seconds": rounded(result.seconds), "peak_memory_mb": peak_memory_mb()}
    write_text(folder / REPORT_FILE, report_json(report))
    return report, [*written, folder / REPORT_FILE]


def write_report(folder: Path, result: MappingResult, facts: RunFacts) -> None:
    """Write only the report, without a check, and the parameters. Raises MapFileError."""
    write_text(folder / CONFIG_FILE, commented_yaml(facts.config))
    write_text(folder / REPORT_FILE, report_json(facts.report(result, None)))


def write_voxel_file(path: Path, m: OccupancyMap) -> int:
    """Write the occupied voxels, of a map with a window as of its last save, in the colours that cameras saw
    if the map has them; returns their number. Raises MapFileError."""
    centres, probability = (in_chunks(m) or m).decided.voxels(min_probability=0.5)
    shown = photo_at(m, centres), None, m.config.volume.origin, layers_at(m, centres)
    write_voxels(path, centres, probability, m.voxel_size, *shown)
    return len(centres)


def write_mesh_file(path: Path, m: OccupancyMap) -> str:
    """Write the mesh that ``export --mesh`` writes; returns in words what it shows. Raises TaichiMRFError."""
    options = ExportOptions(mesh=True)
    export_map(m, path, options)
    return export_note(m, path, options) or ""


def _nothing_occupied(config: Config, dataset: Dataset | None) -> str:
    """Why no voxel is occupied, in words."""
    depths_m = np.ones(1, np.float32) if dataset is None else some_depths(dataset)
    median_m = float(np.median(depths_m)) if len(depths_m) else 0.0
    reach_m = config.sensor.max_depth
    if not len(depths_m):
        why = "the frames that were looked at have no measured depth"
    elif median_m < config.voxel_size:
        why = f"the median depth is {median_m:.2g} m, less than a voxel: check --depth-scale"
    elif median_m > reach_m:
        why = f"the median depth is {median_m:.3g} m, beyond sensor.max_depth, {reach_m:g} m"
    else:
        why = METHODS[config.method].if_empty or "no frame confirms what another one saw: check the poses"
    return f"The map is empty: no voxel has a probability of 0.5 or more; {why}."


def _write_map(
    folder: Path, result: MappingResult, config: Config, haste: Haste, advance: Advance
) -> tuple[list[Path], int | None]:
    """Returns the paths and the number of occupied voxels, None if they are left out: to find them takes ten
    times as long as to save the map."""
    advance("Writing", 0, 2)
    occupied = None
    with result.timed("writing"):
        result.map.save(folder / MAP_FILE)
        write_text(folder / CONFIG_FILE, commented_yaml(config))
        advance("Writing", 1, 2)
        written = [folder / MAP_FILE, folder / CONFIG_FILE]
        if not haste():
            occupied = write_voxel_file(folder / VOXEL_FILE, result.map)
            written.insert(1, folder / VOXEL_FILE)
        advance("Writing", 2, 2)
        if window_of(result.map) is not None:
            written.append(folder / WINDOW_FOLDER)
        if result.track is not None:
            z_up = any(k.camera.up[2] > 0 for k in result.map.keyframes.values())
            poses = result.track.trajectory(result.map)
            axes = LIDAR_AXES if z_up else CAMERA_AXES
            write_trajectory(folder / TRAJECTORY_FILE, poses, axes, config.volume.origin)
            written.append(folder / TRAJECTORY_FILE)
    return written, occupied


def _left_out(voxels: bool, check: bool, pictures: bool) -> list[str]:
    """A note on what a run that was stopped did not make; none if it made all."""
    parts = {VOXEL_FILE: voxels, "the check against held-out frames": check, "the pictures": pictures}
    missing = ", ".join(part for part, is_missing in parts.items() if is_missing)
    return [f"Left out, because the run was stopped: {missing}; --resume makes it."] if missing else []


def _check(
    result: MappingResult,
    dataset: Dataset,
    haste: Haste,
    advance: Advance,
    render: Render | None,
    keep: Collection[int],
) -> HeldOutCheck | None:
    """None if no frame was held out, or if the run has to end before the check does."""
    if not result.held_out or haste():
        return None

    def checked(number: int) -> None:
        if haste():
            raise CutShortError
        advance("Checking", number, len(result.held_out))

    try:
        with result.timed("checking"):
            check = check_held_out(result.map, dataset, result.held_out, checked, render, keep)
    except CutShortError:
        return None
    result.skipped.update(check.skipped)
    return check


def _calibrate(result: MappingResult, dataset: Dataset, advance: Advance) -> None:
    """Find what levels of free space mean in the finished map, before it is written."""
    m = result.map
    if not m.settled or result.interrupted or not result.held_out:
        return
    # A window is where the camera was last.
    held_out = result.held_out if window_of(m) is None else result.held_out[-MOST_FRAMES:]
    advance("Free space", 0, 1)
    with result.timed("checking"):
        m.promise = calibrate_free(m, _readable(dataset, spread_frames(held_out)))
    advance("Free space", 1, 1)


def _check_noise(
    result: MappingResult, frames: Sequence[Frame], haste: Haste, most: float
) -> NoiseCheck | None:
    """None if the frames that were held out do not tell, or if the run has to end before they do."""

    def checked() -> None:
        if haste():
            raise CutShortError

    try:
        with result.timed("checking"):
            return check_noise(result.map, frames, checked, most)
    except CutShortError:
        return None


def _write_pictures(
    folder: Path,
    result: MappingResult,
    dataset: Dataset | None,
    check: HeldOutCheck | None,
    haste: Haste,
    advance: Advance,
) -> list[Path]:
    """The pictures; none if the run has to end before they are drawn."""
    advance("Drawing", 0, 1)
    try:
        with result.timed("pictures"), haste.cutting_short():
            held_out = _spread(result.held_out, PICTURED_FRAMES)
            if check is not None:
                kept = [check.kept[index] for index in held_out if index in check.kept]
                frames, rendered_m = [frame for frame, _ in kept], [depth_m for _, depth_m in kept]
            else:
                frames, rendered_m = [] if dataset is None else _readable(dataset, held_out), []
            pictures = write_pictures(folder, result.map, frames, rendered_m)
    except CutShortError:
        return []
    advance("Drawing", 1, 1)
    return pictures


def _spread(indices: Sequence[int], count: int) -> Sequence[int]:
    """Up to ``count`` of the indices, evenly spread."""
    if len(indices) <= count:
        return indices
    return [indices[(2 * k + 1) * len(indices) // (2 * count)] for k in range(count)]


def _readable(dataset: Dataset, indices: Sequence[int]) -> list[Frame]:
    frames = []
    for index in indices:
        try:
            frames.append(dataset.read(index))
        except FrameError:  # the report names it since the check
            continue
    return frames
