"""What ``taichi-mrf map`` does: map a sequence, check the map, write the files, print the report."""

import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from taichi_mrf import runtime
from taichi_mrf.commands.interrupt import StopRequest, stop_on_signals
from taichi_mrf.commands.map import CONFIG_FILE, Map
from taichi_mrf.commands.map_keep import MAP_FILE, REPORT_FILE, Keeper, resumed_map, skipped_before
from taichi_mrf.commands.output import DID_NOT_FIT, output_folder
from taichi_mrf.commands.progress import ProgressBar
from taichi_mrf.commands.report import print_report, report_json, run_report, unfinished_report
from taichi_mrf.config import Config, with_absolute_tables
from taichi_mrf.config_text import commented_yaml
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.held_out import HeldOutCheck, check_held_out
from taichi_mrf.evaluation.pictures import write_pictures
from taichi_mrf.export.atomic import write_text
from taichi_mrf.export.ply import write_voxels
from taichi_mrf.frame import Frame
from taichi_mrf.pipeline import MappingResult, map_sequence

VOXEL_FILE = "voxels.ply"

LOOK_AT_PICTURES = "Look at the .png files, or open"
OPEN_VOXELS = "voxels.ply in MeshLab, CloudCompare or Blender."
LIVE_VIEW = "shows the map in the browser."

_PICTURED_FRAMES = 3


def run_map(options: Map) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = Console(stderr=options.json)
    settings = with_absolute_tables(options.parameters(), Path.cwd())
    with (
        output_folder(options.out),
        stop_on_signals(lambda text: console.print(f"[yellow]{text}[/]")) as request,
    ):
        start = time.perf_counter()
        runtime.init(settings.runtime.arch, settings.runtime.threads, settings.runtime.debug)
        previous = resumed_map(options.out, settings) if options.resume else None
        skipped = skipped_before(options.out) if options.resume else {}
        dataset = open_dataset(options.source, color=False, **options.reading.keywords())
        opening = time.perf_counter() - start
        with ProgressBar(console) as progress, _collected_warnings() as warned:
            result = map_sequence(
                dataset,
                settings,
                progress.listen,
                every=options.every,
                limit=options.limit,
                skip_bad_frames=options.skip_bad_frames,
                should_stop=request,
                resume_from=previous,
                keep=Keeper(
                    options.out,
                    settings,
                    options.keep_every,
                    lambda result: report_json(unfinished_report(result, dataset, options.source, skipped)),
                ),
            )
            result.seconds = {"opening": opening, **result.seconds}
            check = _check(result, dataset, progress)
            written = _write_map(options.out, result, settings, progress)
            if options.pictures:
                written += _write_pictures(options.out, result, dataset, progress)
        report = run_report(result, dataset, options.source, check)
        report["notes"] += [str(warning.message) for warning in warned]
        report["skipped_frames"] = skipped | report["skipped_frames"]
        write_text(options.out / REPORT_FILE, report_json(report))
        if options.json:
            print(report_json(report), end="")
            return _exit_status(request, result)
        print_report(console, report, [*written, options.out / REPORT_FILE])
        look = LOOK_AT_PICTURES if options.pictures else "Open"
        live = f"taichi-mrf live {options.out / MAP_FILE} {LIVE_VIEW}"
        console.print(f"{look} {OPEN_VOXELS} {live}", highlight=False, markup=False)
    return _exit_status(request, result)


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
    return [folder / MAP_FILE, folder / VOXEL_FILE, folder / CONFIG_FILE]


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


def _exit_status(request: StopRequest, result: MappingResult) -> int:
    """0, or what a shell expects of a program that was stopped by a signal, or, after one line that says so,
    DID_NOT_FIT."""
    if request.signal is not None:
        return 128 + request.signal
    if result.full is None:
        return 0
    kept = f"the map of {len(result.map.keyframes)} keyframes is kept; --resume with more memory goes on"
    print(f"taichi-mrf: {result.full}; {kept}", file=sys.stderr)
    return DID_NOT_FIT
