"""What ``taichi-mrf map`` does: map a sequence, check the map, write the files, print the report."""

import json
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from taichi_mrf import runtime
from taichi_mrf.commands.interrupt import StopRequest, stop_on_signals
from taichi_mrf.commands.map import CONFIG_FILE, Map
from taichi_mrf.commands.output import output_folder
from taichi_mrf.commands.progress import ProgressBar
from taichi_mrf.commands.report import print_report, report_json, run_report
from taichi_mrf.config import Config, load, with_absolute_tables
from taichi_mrf.config_text import commented_yaml, differences
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.reposed import reposed
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError, FrameError, MapFileError
from taichi_mrf.evaluation.held_out import HeldOutCheck, check_held_out
from taichi_mrf.evaluation.pictures import write_pictures
from taichi_mrf.export.atomic import write_text
from taichi_mrf.export.ply import write_voxels
from taichi_mrf.export.trajectory import write_trajectory
from taichi_mrf.frame import Frame
from taichi_mrf.maps.create import load_map
from taichi_mrf.maps.protocol import OccupancyMap
from taichi_mrf.pipeline import MappingResult, map_sequence

MAP_FILE, VOXEL_FILE, REPORT_FILE = "map.npz", "voxels.ply", "report.json"
TRAJECTORY_FILE = "trajectory.txt"

MAY_CHANGE = ("inference.sweeps", "inference.tolerance", "runtime.")
"""Parameters (or groups) that may differ from those of the run that --resume goes on with."""

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
    )


def run_map(options: Map) -> int:
    """Carry out the command for one source; returns the exit status. Raises TaichiMRFError."""
    console = Console(stderr=options.json)
    task = map_task(options, options.sources[0], options.out)
    with stop_on_signals(lambda text: console.print(f"[yellow]{text}[/]")) as request:
        with ProgressBar(console) as progress:
            report, written = map_to_folder(task, progress, request)
        print_run(console, options, report, written)
    return exit_status(request)


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
    task: MapTask, progress: ProgressBar, should_stop: Callable[[], bool]
) -> tuple[dict[str, Any], list[Path]]:
    """Map one sequence and write its files, the report last; returns the report and the files.

    A run that ``should_stop`` ended says so in its report. Raises TaichiMRFError.
    """
    with output_folder(task.out):
        start = time.perf_counter()
        settings = task.settings
        runtime.init(settings.runtime.arch, settings.runtime.threads, settings.runtime.debug)
        previous = _resumed_map(task.out, settings) if task.resume else None
        dataset = open_dataset(task.source, color=False, track=task.track_poses, **task.reading.keywords())
        opening = time.perf_counter() - start
        with _collected_warnings() as warned:
            result = map_sequence(
                dataset,
                settings,
                progress.listen,
                every=task.every,
                limit=task.limit,
                skip_bad_frames=task.skip_bad_frames,
                should_stop=should_stop,
                resume_from=previous,
            )
            result.seconds = {"opening": opening, **result.seconds}
            posed = dataset if result.track is None else reposed(dataset, result.track.poses(result.map))
            check = _check(result, posed, progress)
            written = _write_map(task.out, result, settings, progress)
            if task.pictures:
                written += _write_pictures(task.out, result, posed, progress)
        report = run_report(result, dataset, task.source, check)
        report["notes"] += [str(warning.message) for warning in warned]
        if task.resume:
            report["skipped_frames"] = _skipped_before(task.out) | report["skipped_frames"]
        report |= task.choice()
        write_text(task.out / REPORT_FILE, report_json(report))
    return report, [*written, task.out / REPORT_FILE]


def _resumed_map(folder: Path, settings: Config) -> OccupancyMap | None:
    """The map of the run to go on with; None if that run was stopped before it wrote one."""
    if not (folder / MAP_FILE).exists():
        return None
    if (folder / CONFIG_FILE).exists():
        changed = [
            name
            for name in differences(load(folder / CONFIG_FILE), settings)
            if not name.startswith(MAY_CHANGE)
        ]
        if changed:
            raise ConfigError(
                f"{folder / CONFIG_FILE}: made with another {', '.join(changed)}; "
                "--resume goes on with the same parameters"
            )
    return load_map(folder / MAP_FILE)


@contextmanager
def _collected_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """What this package warns of while the block runs, for the report instead of the terminal."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module="taichi_mrf")
        yield warned


def _check(result: MappingResult, dataset: Dataset, progress: ProgressBar) -> HeldOutCheck | None:
    if not result.held_out:
        return None
    with result.timed("checking"):
        check = check_held_out(
            result.map,
            dataset,
            result.held_out,
            lambda number: progress.advance("Checking", number, len(result.held_out)),
        )
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
    folder: Path, result: MappingResult, dataset: Dataset, progress: ProgressBar
) -> list[Path]:
    progress.advance("Drawing", 0, 1)
    with result.timed("pictures"):
        frames = _readable(dataset, _spread(result.held_out, _PICTURED_FRAMES))
        pictures = write_pictures(folder, result.map, frames)
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


def _skipped_before(folder: Path) -> dict[str, str]:
    """The broken frames that the run before has met and this one does not read again."""
    path = folder / REPORT_FILE
    if not path.exists():
        return {}
    try:
        report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return dict(report.get("skipped_frames", {}))
    except (OSError, ValueError) as error:
        raise MapFileError(f"{path}: cannot be read: {error}") from error


def exit_status(request: StopRequest) -> int:
    """0, or what a shell expects of a program that was stopped by a signal."""
    return 0 if request.signal is None else 128 + request.signal
