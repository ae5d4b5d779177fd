"""Common input of a run's tasks, one JSON file of its folder: the source, the parameters and the plan."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.config.text import differences
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.errors import MapFileError, said
from taichi_mrf.submaps.plan import Plan, Submap
from taichi_mrf.system.atomic import write_text
from taichi_mrf.voxels.layers import COLORS, FIRST, SURFACE

PLAN_FILE = "plan.json"

FREE_TO_DIFFER = ("runtime.", "volume.memory_limit_gb")
"""Parameters (or groups) that may differ from one part of a run to the next."""


@dataclass(frozen=True)
class Sequence:
    """Which frames are mapped: what ``open_dataset`` is given, and every ``every``-th frame, ``limit`` of
    them at most."""

    source: str
    reading: dict[str, Any]
    every: int = 1
    limit: int | None = None

    def open(self, color: bool = False) -> Dataset:
        """The recording, with its colour images or without. Raises DatasetError."""
        return open_dataset(self.source, color=color, **self.reading)


@dataclass(frozen=True)
class Job:
    """A sequence, how it is mapped, and how it is cut. ``skipped`` has the problem of each unreadable frame
    by name; ``centres_m`` are the camera centres of all keyframes, by their index in the dataset;
    ``up`` is the name of the world axis that is up, empty in plans of earlier versions."""

    sequence: Sequence
    config: Config
    submap_size: float
    plan: Plan
    centres_m: dict[int, tuple[float, float, float]]
    skipped: dict[str, str]
    up: str = ""

    @property
    def layers(self) -> tuple[str, ...]:
        """The layers of the map beside log-odds."""
        measured = (SURFACE, FIRST) if self.config.keep_surface else ()
        return (COLORS, *measured) if self.config.color else measured

    def write(self, folder: Path) -> None:
        """Write the plan's file. Raises MapFileError."""
        plan = {"chunks_across": self.plan.chunks_across, "submaps": [asdict(s) for s in self.plan.submaps]}
        content = {
            "sequence": asdict(self.sequence),
            "config": to_yaml(self.config),
            "submap_size": self.submap_size,
            "centres_m": self.centres_m,
            "skipped": self.skipped,
            "up": self.up,
            "plan": plan,
        }
        write_text(folder / PLAN_FILE, json.dumps(content) + "\n")

    @staticmethod
    def read(folder: Path) -> "Job":
        """Read it back. Raises MapFileError."""
        path = folder / PLAN_FILE
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            plan = content["plan"]
            submaps = [Submap(tuple(s["cell"]), tuple(s["keyframes"])) for s in plan["submaps"]]
            return Job(
                Sequence(**content["sequence"]),
                from_dict(Config, parse_yaml(content["config"]), str(path)),
                content["submap_size"],
                Plan(plan["chunks_across"], tuple(submaps)),
                {int(index): tuple(centre) for index, centre in content["centres_m"].items()},
                content["skipped"],
                content.get("up", ""),
            )
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise MapFileError(f"{path}: not a readable plan of submaps: {said(error)}") from error

    def differences(self, sequence: Sequence, config: Config, submap_size: float) -> list[str]:
        """Names of the settings in which another run differs, as far as they change its result."""
        # As JSON, in which a tuple is a list.
        mine, other = (json.loads(json.dumps(asdict(each))) for each in (self.sequence, sequence))
        found = [name for name in mine if mine[name] != other[name]]
        found += [name for name in differences(self.config, config) if not name.startswith(FREE_TO_DIFFER)]
        return found + (["submap_size"] if submap_size != self.submap_size else [])
