"""One sequence to map into one folder, and the run that the folder holds already: whether it is the same,
finished, and may be replaced."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.options.shared import NoiseFlags
from taichi_mrf.config.schema import Config, load, with_absolute_tables
from taichi_mrf.config.text import differences
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.doctor.remedy import remedy
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.registry import is_rendered
from taichi_mrf.errors import ConfigError, DatasetError, MapFileError, TaichiMRFError
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.mapping.onto import parameters_onto
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import config_in_memory
from taichi_mrf.methods.map_file import open_map_file, read_header
from taichi_mrf.session.files import CONFIG_FILE, MAP_FILE, REPORT_FILE, VOXEL_FILE, holds_run
from taichi_mrf.system import runtime

LEARNT = ("sensor.sigma_scale", "sensor.sigma_added", "inference.surface_density", "inference.outlier_floor")
"""The parameters that --noise auto changes."""

_RECORDED = ("voxel_size", "fit_voxel_size", "sensor.sigma", "sensor.max_depth", "inference.outlier_floor")
"""The parameters that a run may have had from the recording."""

_FILES = (MAP_FILE, VOXEL_FILE, CONFIG_FILE)


Status = Literal["mapped", "finished before", "stopped", "failed", "refused", "not done"]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a sequence: the report of its run, or one line that says why there is none."""

    status: Status
    report: dict[str, Any] | None = None
    error: str | None = None


@dataclass(frozen=True)
class MapTask:
    """One sequence to map into a folder: the options of a command that names only this one.

    Paths are relative to ``start``, the working directory of the command; those in the settings are absolute.
    """

    options: Map
    start: Path

    def __str__(self) -> str:
        return self.source

    @property
    def source(self) -> str:
        """The sequence."""
        return self.options.sources[0]

    @property
    def out(self) -> Path:
        """The folder of its files."""
        return self.options.out

    @property
    def settings(self) -> Config:
        """The parameters."""
        return self.options.settings

    @cached_property
    def mistakes(self) -> list[str]:
        """The oddities of the recording, with the command that fixes them; checked once, in seconds."""
        try:
            found = remedy(self.source, self.options.poses.file, self.options.reading)
        except DatasetError:  # such as a recording without poses
            return []
        return [found.in_words()] if found.found.findings else []

    def choice(self) -> dict[str, Any]:
        """Choices besides the parameters; the report says them too."""
        options = self.options
        noise = {} if options.noise == NoiseFlags() else {"noise_from": options.noise.origin}
        onto = {"onto": options.onto and str(options.onto), "frozen_before": options.frozen or None}
        return {"every": options.every, "limit": options.limit, **onto, **noise, **options.poses.choice()}

    def open(self, color: bool) -> Dataset:
        """Open the sequence. Raises DatasetError."""
        flags = self.options.poses
        reading = {"color": color, **self.options.reading.keywords()}
        return open_posed(self.source, flags.file, follow=flags.follow, track=flags.track_poses, **reading)


def map_task(options: Map, source: str, out: Path) -> MapTask:
    """The part of a command that concerns one of its sources. With ``--onto`` the parameters are those of
    that map: raises MapFileError, and ConfigError for others."""
    start = Path.cwd()
    settings = with_absolute_tables(options.poses.parameters(options.settings), start)
    if options.onto is not None:
        settings = settings_onto(options.onto, settings, Config())
    return MapTask(replace(options, sources=(source,), out=out, settings=settings), start)


def settings_onto(onto: Path, asked: Config, default: Config) -> Config:
    """The parameters with which a recording goes on in a saved map (:func:`.parameters_onto`). Raises
    MapFileError, and ConfigError for others that are asked for."""
    if onto.suffix == SUFFIX:
        of_map = config_in_memory(ChunkedMap.open(onto))
    else:
        with open_map_file(onto) as file:
            of_map = read_header(onto, file).config
    return parameters_onto(of_map, asked, default, str(onto))


def refuse_other_run(task: MapTask) -> dict[str, Any] | None:
    """Check the run that a task's folder holds, unless the task is to resume or overwrite it.

    Returns the report if the folder holds the finished run of this very task, None if it holds no run. Raises
    ConfigError, which says what to do, for any other run.
    """
    if task.options.resume or task.options.overwrite or not holds_run(task.out):
        return None
    report = report_in(task.out)
    if report is None or not (task.out / CONFIG_FILE).is_file():
        raise ConfigError(f"{task.out}: holds files of another run: choose another --out, or add --overwrite")
    changed = [name for name in _changes(task, report) if not name.startswith("runtime.")]
    if changed:
        raise ConfigError(
            f"{task.out}: holds a run with another {', '.join(changed)}: choose another --out, or add "
            "--overwrite to replace it"
        )
    finished = finished_report(task)
    if finished is None:
        raise ConfigError(
            f"{task.out}: holds an unfinished run of the same parameters: --resume continues it, --overwrite "
            "starts anew"
        )
    return finished


def _changes(task: MapTask, report: dict[str, Any]) -> list[str]:
    """The names of what differs between the task and the run in its folder."""
    asked = {"source": task.source, **task.choice()}
    changed = [name for name, value in asked.items() if report.get(name) != value]
    return changed + _changed_parameters(task)


def _changed_parameters(task: MapTask) -> list[str]:
    """The names of the parameters in which the task differs from the run in its folder."""
    held = load(task.out / CONFIG_FILE)
    changed = differences(held, task.settings)
    if set(_RECORDED) & set(changed):
        if is_rendered(task.source):
            runtime.init(task.settings.runtime.arch, task.settings.runtime.threads)
        if task.options.onto is None:
            changed = differences(held, with_recorded_noise(task.settings, task.open(color=False)))
    return [name for name in changed if not (name in LEARNT and _learns_noise(task))]


def _learns_noise(task: MapTask) -> bool:
    """True if the run in its folder, if it is the same, has learnt its noise."""
    noise = (report_in(task.out) or {}).get("noise") or {}
    return task.options.noise.is_learnt or (task.options.noise.is_checked and noise.get("learnt") is not None)


def finished_report(task: MapTask) -> dict[str, Any] | None:
    """The report in the task's folder, if its run was complete and the same."""
    report = report_in(task.out)
    if report is None or not all((task.out / name).is_file() for name in _FILES):
        return None
    if report.get("source") != task.source:
        raise MapFileError(f"{task.out}: holds the map of {report.get('source')}: choose another --out")
    changed = _changed_parameters(task)
    chosen = all(report.get(name) == value for name, value in task.choice().items())
    same = chosen and all(name.startswith("runtime.") for name in changed)
    return report if same and not report.get("interrupted") else None


def finished_before(task: MapTask) -> Outcome | None:
    """The outcome of a complete run of the same task, if the folder holds it. A folder that holds another
    sequence is a failure."""
    try:
        report = finished_report(task)
    except TaichiMRFError as error:
        return Outcome("failed", error=str(error))
    return None if report is None else Outcome("finished before", report)


def report_in(folder: Path) -> dict[str, Any] | None:
    path = folder / REPORT_FILE
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise MapFileError(f"{path}: cannot be read: {error}") from error
    if not isinstance(report, dict):
        raise MapFileError(f"{path}: not the report of a run")
    return report
