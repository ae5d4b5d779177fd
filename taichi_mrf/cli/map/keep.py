"""Checkpoints of a mapping run, and how a run resumes from one.

The report is written first and says that the run is unfinished, the map last: whenever the process is killed,
every file is whole, no report calls an unfinished map finished, and --resume finds a map with its parameters.
"""

import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taichi_mrf.config.schema import Config, load
from taichi_mrf.config.text import commented_yaml, differences
from taichi_mrf.errors import ConfigError, MapFileError, said
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.session.files import CONFIG_FILE, MAP_FILE, REPORT_FILE
from taichi_mrf.session.report import report_json
from taichi_mrf.system.atomic import write_text

MAY_CHANGE = (
    "inference.sweeps",
    "poses.follow_",
    "runtime.",
    "volume.memory_limit_gb",
)
"""Parameters (or groups) in which a resumed run may differ."""

MOST_OF_THE_TIME = 0.05
"""Share of a run's time that saving the map on the way may take."""


class Keeper:
    """Saves the map of a run when it is called and enough time has passed: ``every_s`` seconds, and long
    enough that saving takes at most its share. ``report`` makes the report of an unfinished run."""

    def __init__(
        self,
        folder: Path,
        settings: Config,
        every_s: float,
        report: Callable[[MappingResult], dict[str, Any]],
    ) -> None:
        self._folder, self._settings, self._every_s = folder, settings, every_s
        self._report = report
        self._last, self._cost = time.perf_counter(), 0.0

    def __call__(self, result: MappingResult) -> None:
        """Save the map if it is time. A failure is only a warning: the run continues, and the disk may have
        space at its end."""
        begin = time.perf_counter()
        if begin - self._last < max(self._every_s, self._cost / MOST_OF_THE_TIME):
            return
        with result.timed("keeping"):
            try:
                write_text(self._folder / REPORT_FILE, report_json(self._report(result)))
                write_text(self._folder / CONFIG_FILE, commented_yaml(self._settings))
                result.map.save(self._folder / MAP_FILE)
            except MapFileError as error:
                warnings.warn(f"the checkpoint could not be written: {error}", stacklevel=2)
        self._last = time.perf_counter()
        self._cost = self._last - begin


def resumed_map(folder: Path, settings: Config) -> OccupancyMap | None:
    """The map of the run to go on with; None if that run was stopped before it wrote one. Raises ConfigError
    for other parameters than those, MapFileError for a map that cannot be read."""
    if not (folder / MAP_FILE).exists():
        return None
    if (folder / CONFIG_FILE).exists():
        refuse_changes(folder / CONFIG_FILE, differences(load(folder / CONFIG_FILE), settings))
    m = load_map(folder / MAP_FILE, settings.volume.memory_limit_gb)
    # Maps of earlier versions saved only these parameters.
    known = (
        "voxel_size",
        "method",
        "sensor.min_depth",
        "sensor.max_depth",
        "volume.",
        f"{m.METHOD.section}.",
    )
    refuse_changes(
        folder / MAP_FILE, [name for name in differences(m.config, settings) if name.startswith(known)]
    )
    return m


def refuse_changes(path: Path, names: list[str]) -> None:
    """Raise ConfigError if among the ``names`` of the parameters that a resumed run would change there is one
    that its map depends on; ``path`` has those that it began with."""
    changed = [name for name in names if not name.startswith(MAY_CHANGE)]
    if changed:
        raise ConfigError(
            f"{path}: made with another {', '.join(changed)}; --resume needs the same parameters, and "
            "--overwrite replaces the run"
        )


def skipped_before(folder: Path) -> dict[str, str]:
    """The broken frames that the run before has met and this one does not read again. Raises MapFileError."""
    path = folder / REPORT_FILE
    if not path.exists():
        return {}
    try:
        report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): str(problem) for name, problem in report.get("skipped_frames", {}).items()}
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise MapFileError(f"{path}: cannot be read: {said(error)}") from error
