"""Batch mapping: a recording in, a folder with its map, a report and pictures out.

    python apps/batch.py recording/ --out runs/desk     in a clone
    taichi-mrf map recording/ --out runs/desk           installed: the same file

A recording is a source of frames: depth images with poses. Frames become keyframes of a map, the map is
inferred, and what is known of it is written to the folder.
"""

import sys
import time
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # the command line parses the options, and calls the function below
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    from taichi_mrf.cli.start import start

    sys.exit(start("map"))

from taichi_mrf.cli.map.keep import Keeper, resumed_map, skipped_before
from taichi_mrf.cli.map.lines import exit_status, listener_of, print_finished, print_run
from taichi_mrf.cli.map.reading import learnt_from, located_onto, open_recording
from taichi_mrf.cli.map.several import map_several
from taichi_mrf.cli.map.submaps import map_submaps
from taichi_mrf.cli.map.task import MapTask, map_task, refuse_other_run
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest, interrupt_on_signals, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal, tell_first_run
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import collected_warnings
from taichi_mrf.mapping.pipeline import SequenceRun
from taichi_mrf.session.files import MAP_FILE
from taichi_mrf.session.folder import RunFacts, write_run
from taichi_mrf.system import runtime


def run_map(options: Map) -> int:
    """Map one sequence here, or several, or a very large one, in processes of their own; returns the exit
    status. Raises TaichiMRFError, also after everything is written if a sequence has failed."""
    console = open_terminal(options.printing, stderr=options.json)
    several, in_submaps = len(options.sources) > 1, options.submap_size is not None
    here = not (several or in_submaps or options.scheduler is not None)
    signals = stop_on_signals if here else interrupt_on_signals
    with (
        # The task of one sequence on a cluster locks the folder itself.
        output_folder(options.out, locked=here or several or in_submaps),
        signals(lambda text: console.print_line(text, "yellow")) as request,
    ):
        if in_submaps:
            return map_submaps(options, console, request)
        if not here:
            return map_several(options, console, request, map_to_folder)
        return _map_here(options, console, request)


def _map_here(options: Map, console: Terminal, request: StopRequest) -> int:
    task = map_task(options, options.sources[0], options.out)
    finished = refuse_other_run(task)
    if finished is not None:
        print_finished(console, options, finished)
        return 0
    tell_first_run(options.printing)
    with ProgressBar(console, options.printing) as progress:
        report, written = map_to_folder(task, progress, request)
    print_run(console, options, report, written)
    return exit_status(options, report, request)


def map_to_folder(
    task: MapTask, progress: ProgressBar, request: StopRequest
) -> tuple[dict[str, Any], list[Path]]:
    """Map one sequence and write its files into its folder, which exists; returns the report and the files.

    A run that the ``request`` stopped says so in its report; one that has to end within seconds is neither
    checked nor drawn. Raises TaichiMRFError.
    """
    options, seconds, start = task.options, dict[str, float](), time.perf_counter()

    # The source: a recording as a table of frames, and the parameters, which may depend on it.
    runtime.init(task.settings.runtime.arch, task.settings.runtime.threads)
    dataset, settings = open_recording(task)
    dataset, onto = located_onto(task, dataset)
    previous = resumed_map(task.out, settings) if options.resume else None
    skipped = skipped_before(task.out) if options.resume else {}
    seconds["opening"] = time.perf_counter() - start

    with collected_warnings() as warned:
        start = time.perf_counter()
        learnt = learnt_from(task, dataset, settings, progress, request)
        if learnt is not None:
            settings = learnt.put_into(settings)
        took = time.perf_counter() - start
        if took > 0.05:  # most recordings are not looked at
            seconds["learning noise"] = took
        facts = RunFacts(task.source, settings, dataset, task.choice(), skipped, warned, learnt)

        # The map: an empty one, that of an earlier recording, or that of a run which was stopped.
        run = SequenceRun(
            dataset,
            settings,
            listener_of(progress),
            every=options.every,
            limit=options.limit,
            skip_bad_frames=options.skip_bad_frames,
            should_stop=request,
            out_of_time=request.out_of_time,
            resume_from=previous,
            keep=Keeper(task.out, settings, options.keep_every, facts.unfinished),
            map_path=task.out / MAP_FILE,
            onto=onto,
        )
        run.add_keyframes()  # the loop over frames: read, track or trust the pose, choose, add, align
        run.settle()  # align all with each other if poses are refined, then infer the marginals

        # The folder: the map, its check against frames that were held out, pictures, the report.
        run.result.seconds = {**seconds, **run.result.seconds}
        return write_run(
            task.out,
            run.result,
            facts,
            pictures=options.pictures,
            haste=request,
            advance=progress.advance,
            mistakes_of=lambda posed: task.mistakes,
        )
