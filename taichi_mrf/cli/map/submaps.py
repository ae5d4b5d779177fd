"""Command ``taichi-mrf map --submap-size``: a long sequence in submaps, and one map in chunks out."""

from pathlib import Path
from typing import Any

import taichi_mrf
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest
from taichi_mrf.cli.shared.print_table import print_facts
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.cluster.choose import open_runner
from taichi_mrf.cluster.submaps.picture import write_submap_picture
from taichi_mrf.cluster.submaps.plan import SourceFrames
from taichi_mrf.cluster.submaps.rounds import SubmapsResult, map_in_submaps
from taichi_mrf.config.schema import with_absolute_tables
from taichi_mrf.config.text import commented_yaml
from taichi_mrf.datasets.registry import absolute_source
from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.session.files import CONFIG_FILE, REPORT_FILE
from taichi_mrf.session.report import report_json
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.libraries import library
from taichi_mrf.voxels.layout import VOXELS

TASK_FOLDER, MAP_FOLDER, PICTURE_FILE = "submaps", "map.zarr", "submaps.png"


def map_submaps(options: Map, console: Terminal, request: StopRequest) -> int:
    """Map one sequence in submaps; returns the exit status. Raises TaichiMRFError."""
    assert options.submap_size is not None
    if len(options.sources) != 1:
        raise ConfigError("--submap-size takes one SOURCE")
    if options.poses.track_poses:
        raise ConfigError("--track-poses does not work with --submap-size: no task has all keyframes")
    library("zarr", "maps in chunks need", "store")  # fails before the work, not after it
    settings = with_absolute_tables(options.poses.parameters(options.settings), Path.cwd())
    source = absolute_source(options.sources[0])
    reading = options.reading.within(Path.cwd())
    sequence = SourceFrames(source, reading.keywords(), options.every, options.limit)
    if not options.resume:  # which takes its parameters from here
        _refuse_to_replace(options)
        (options.out / REPORT_FILE).unlink(missing_ok=True)
        write_text(options.out / CONFIG_FILE, commented_yaml(settings))
    result = None
    with (
        request.ending(),
        ProgressBar(console, options.printing) as progress,
        open_runner(options.jobs, options.scheduler) as runner,
    ):
        result = map_in_submaps(
            sequence,
            settings,
            options.submap_size,
            options.out / TASK_FOLDER,
            options.out / MAP_FOLDER,
            runner,
            rounds=options.rounds,
            resume=options.resume,
            skip_bad_frames=options.skip_bad_frames,
            progress=progress.advance,
        )
    if result is None:
        console.print_line("Stopped before the end; --resume continues from here.", "yellow")
    else:
        _print_result(console, options, result, _write(options, result))
    return request.exit_status


def _refuse_to_replace(options: Map) -> None:
    """Raise ConfigError if the folder holds a run and --overwrite was not given."""
    held = [name for name in (CONFIG_FILE, REPORT_FILE, MAP_FOLDER) if (options.out / name).exists()]
    if held and not options.overwrite:
        raise ConfigError(
            f"{options.out}: holds an earlier run ({held[0]}): --resume continues it, --overwrite replaces it"
        )


def _write(options: Map, result: SubmapsResult) -> list[Path]:
    """Write the files beside the map; returns the paths of all files."""
    out = options.out
    write_text(out / CONFIG_FILE, commented_yaml(result.job.config))
    written = [out / MAP_FOLDER, out / CONFIG_FILE]
    write_text(out / REPORT_FILE, report_json(submaps_report(result)))
    written.append(out / REPORT_FILE)
    if options.pictures:
        m = ChunkedMap.open(out / MAP_FOLDER)
        write_submap_picture(out / PICTURE_FILE, m, result.job.plan, list(result.job.centres_m.values()))
        written.append(out / PICTURE_FILE)
    return written


def submaps_report(result: SubmapsResult) -> dict[str, Any]:
    """The facts of a run as plain values, lengths in metres."""
    job, last = result.job, result.rounds[-1]
    bricks = sum(each.core_bricks for each in last.submaps)
    return {
        "source": job.sequence.source,
        "method": job.config.method,
        "version": taichi_mrf.__version__,
        "keyframes": len(job.centres_m),
        "voxel_size": job.config.voxel_size,
        "bricks": bricks,
        "voxels": bricks * VOXELS,
        "submap_size": job.submap_size,
        "submaps": len(job.plan.submaps),
        "overlap": job.plan.overlap,
        "sweeps": job.config.inference.sweeps,
        "rounds": [
            {"round": each.round, "seconds": each.seconds, "moved": each.moved, "halo_moved": each.halo_moved}
            for each in result.rounds
        ],
        "largest_task": {
            "keyframes": max(each.keyframes for each in last.submaps),
            "map_memory_mb": max(each.map_mb for each in last.submaps),
            "peak_memory_mb": max(each.peak_memory_mb or 0.0 for each in last.submaps),
        },
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.seconds.items()},
        "every": job.sequence.every,
        "limit": job.sequence.limit,
        "skipped_frames": job.skipped,
    }


def _print_result(console: Terminal, options: Map, result: SubmapsResult, written: list[Path]) -> None:
    report = submaps_report(result)
    if options.json:
        print(report_json(report), end="")
        return
    largest, moved = report["largest_task"], result.rounds[-1].moved
    size = f"{largest['keyframes']} keyframes and {largest['map_memory_mb']:.0f} MB"
    in_the_last = "" if moved is None else f"; {moved:.3%} of the voxels moved in the last"
    facts = [
        ("keyframes", f"{report['keyframes']}, each in {report['overlap']:.2f} submaps"),
        ("submaps", f"{report['submaps']}, the largest with {size}"),
        ("voxels", f"{report['voxels']:,} of {report['voxel_size']} m"),
        ("rounds", f"{len(result.rounds) - 1} of exchange{in_the_last}"),
        ("seconds", ", ".join(f"{stage} {value:.1f}" for stage, value in report["seconds"].items())),
    ]
    print_facts(console, f"Map of {report['source']}", facts)
    for problem in report["skipped_frames"].values():
        console.print_line(f"Skipped: {problem}")
    for path in written:
        console.print_line(str(path))
    box = "--lower X Y Z --upper X Y Z exports a box of it."
    console.print_line(f"taichi-mrf export {options.out / MAP_FOLDER} --to part.ply {box}")
