"""What ``taichi-mrf map`` does: map a sequence, check the map, write the files, print the report."""

import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from taichi_mrf.cli.map.keep import MAP_FILE, REPORT_FILE, Keeper, resumed_map, skipped_before
from taichi_mrf.cli.map.report import print_report, report_json, rounded, run_report, unfinished_report
from taichi_mrf.cli.options.config_file import CONFIG_FILE
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import CutShortError, StopRequest, stop_on_signals
from taichi_mrf.cli.shared.output import DID_NOT_FIT, output_folder
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.config.schema import Config, with_absolute_tables
from taichi_mrf.config.text import commented_yaml
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.derived import reposed
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.held_out import HeldOutCheck, check_held_out
from taichi_mrf.evaluation.pictures.run_pictures import write_pictures
from taichi_mrf.export.ply import write_voxels
from taichi_mrf.export.trajectory import write_trajectory
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.memory import peak_memory_mb

VOXEL_FILE, TRAJECTORY_FILE = "voxels.ply", "trajectory.txt"

LOOK_AT_PICTURES = "Look at the .png files, or open"
OPEN_VOXELS = "voxels.ply in MeshLab, CloudCompare or Blender."
LIVE_VIEW = "shows the map in the browser."

_PICTURED_FRAMES = 3


@dataclass(frozen=True)
class MapTask:
    """One sequence to map into a folder; all that decides what the files will hold.

    Paths are relative to ``start``, the working directory of the command; those in ``settings`` are
    absolute.
    """

    source: str
    out: Path
    start: Path
    settings: Config
    reading: SourceFlags
    every: int = 1
    limit: int | None = None
    skip_bad_frames: bool = False
    resume: bool = False
    pictures: bool = True
    track_poses: bool = False
    keep_every: float = Map.keep_every

    def __str__(self) -> str:
        return self.source

    def choice(self) -> dict[str, Any]:
        """What was asked for besides the parameters; the report says it too."""
        return {"every": self.every, "limit": self.limit, "track_poses": self.track_poses}


def map_task(options: Map, source: str, out: Path) -> MapTask:
    """The part of a command that concerns one of its sources."""
    start = Path.cwd()
    return MapTask(
        source,
        out,
        start,
        with_absolute_tables(options.poses.parameters(options.settings), start),
        options.reading,
        options.every,
        options.limit,
        options.skip_bad_frames,
        options.resume,
        options.pictures,
        options.poses.track_poses,
        options.keep_every,
    )


def run_map(options: Map) -> int:
    """Carry out the command for one source; returns the exit status. Raises TaichiMRFError."""
    console = Console(stderr=options.json)
    task = map_task(options, options.sources[0], options.out)
    with stop_on_signals(lambda text: console.print(f"[yellow]{text}[/]")) as request:
        with ProgressBar(console) as progress:
            report, written = map_to_folder(task, progress, request)
        print_run(console, options, report, written)
    if report["did_not_fit"] is not None and request.signal is None:
        kept = f"the map of {report['keyframes']} keyframes is kept; --resume with more memory goes on"
        print(f"taichi-mrf: {report['did_not_fit']}; {kept}", file=sys.stderr)
    return exit_status(request, report["did_not_fit"])


def print_run(console: Console, options: Map, report: dict[str, Any], written: list[Path]) -> None:
    """Tell what one source has become."""
    if options.json:
        print(report_json(report), end="")
        return
    print_report(console, report, written)
    look = LOOK_AT_PICTURES if options.pictures else "Open"
    live = f"taichi-mrf live {options.out / MAP_FILE} {LIVE_VIEW}"
    console.print(f"{look} {OPEN_VOXELS} {live}", highlight=False, markup=False)


def map_to_folder(
    task: MapTask, progress: ProgressBar, request: StopRequest
) -> tuple[dict[str, Any], list[Path]]:
    """Map one sequence and write its files, the report last; returns the report and the files.

    A run that the ``request`` stopped says so in its report; one that has to end within seconds is neither
    checked nor drawn. Raises TaichiMRFError.
    """
    with output_folder(task.out):
        start = time.perf_counter()
        settings = task.settings
        runtime.init(settings.runtime.arch, settings.runtime.threads, settings.runtime.debug)
        previous = resumed_map(task.out, settings) if task.resume else None
        skipped = skipped_before(task.out) if task.resume else {}
        dataset = open_dataset(task.source, color=False, track=task.track_poses, **task.reading.keywords())
        opening = time.perf_counter() - start

        def report_so_far(result: MappingResult) -> str:
            report = unfinished_report(result, dataset, task.source, skipped)
            return report_json(report | task.choice())

        with _collected_warnings() as warned:
            result = map_sequence(
                dataset,
                settings,
                progress.listen,
                every=task.every,
                limit=task.limit,
                skip_bad_frames=task.skip_bad_frames,
                should_stop=request,
                out_of_time=request.out_of_time,
                resume_from=previous,
                keep=Keeper(task.out, settings, task.keep_every, report_so_far),
            )
            result.seconds = {"opening": opening, **result.seconds}
            posed = dataset if result.track is None else reposed(dataset, result.track.poses(result.map))
            check = _check(result, posed, progress, request)
            written = _write_map(task.out, result, settings, progress)
            report = run_report(result, dataset, task.source, check)
            if task.pictures:
                written += _write_pictures(task.out, result, posed, progress, request)
        # Computed before the pictures, which may be left half-way through a kernel's launch.
        report |= {"seconds": rounded(result.seconds), "peak_memory_mb": peak_memory_mb()}
        report["notes"] += [str(warning.message) for warning in warned]
        report["skipped_frames"] = skipped | report["skipped_frames"]
        report |= task.choice()
        write_text(task.out / REPORT_FILE, report_json(report))
    return report, [*written, task.out / REPORT_FILE]


@contextmanager
def _collected_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """What this package warns of while the block runs, for the report instead of the terminal."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module="taichi_mrf")
        yield warned


def _check(
    result: MappingResult, dataset: Dataset, progress: ProgressBar, request: StopRequest
) -> HeldOutCheck | None:
    """None if no frame was held out, or if the run has to end before the check does."""
    if not result.held_out or request.hurried:
        return None

    def checked(number: int) -> None:
        if request.hurried:
            raise CutShortError
        progress.advance("Checking", number, len(result.held_out))

    try:
        with result.timed("checking"):
            check = check_held_out(result.map, dataset, result.held_out, checked)
    except CutShortError:
        return None
    result.skipped.update(check.skipped)
    return check


def _write_map(folder: Path, result: MappingResult, settings: Config, progress: ProgressBar) -> list[Path]:
    """The map first: it is what the time went into."""
    progress.advance("Writing", 0, 2)
    with result.timed("writing"):
        result.map.save(folder / MAP_FILE)
        write_text(folder / CONFIG_FILE, commented_yaml(settings))
        progress.advance("Writing", 1, 2)
        centres, probability = result.map.voxels(min_probability=0.5)
        write_voxels(folder / VOXEL_FILE, centres, probability, result.map.voxel_size)
        progress.advance("Writing", 2, 2)
        written = [folder / MAP_FILE, folder / VOXEL_FILE, folder / CONFIG_FILE]
        if result.track is not None:
            write_trajectory(folder / TRAJECTORY_FILE, result.track.trajectory(result.map))
            written.append(folder / TRAJECTORY_FILE)
    return written


def _write_pictures(
    folder: Path, result: MappingResult, dataset: Dataset, progress: ProgressBar, request: StopRequest
) -> list[Path]:
    """The pictures, or none if the run has to end before they are drawn: all else is written by then."""
    progress.advance("Drawing", 0, 1)
    try:
        with result.timed("pictures"), request.cutting_short():
            frames = _readable(dataset, _spread(result.held_out, _PICTURED_FRAMES))
            pictures = write_pictures(folder, result.map, frames)
    except CutShortError:
        return []
    progress.advance("Drawing", 1, 1)
    return pictures


def _spread(indices: list[int], count: int) -> list[int]:
    """Up to ``count`` of the indices, evenly spread."""
    if len(indices) <= count:
        return indices
    return [indices[(2 * k + 1) * len(indices) // (2 * count)] for k in range(count)]


def _readable(dataset: Dataset, indices: list[int]) -> list[Frame]:
    frames = []
    for index in indices:
        try:
            frames.append(dataset.read(index))
        except FrameError:  # named in the report since the map was checked
            continue
    return frames


def exit_status(request: StopRequest, did_not_fit: str | None = None) -> int:
    """0, or what a shell expects of a program that was stopped by a signal, or DID_NOT_FIT."""
    if request.signal is not None:
        return 128 + request.signal
    return 0 if did_not_fit is None else DID_NOT_FIT
