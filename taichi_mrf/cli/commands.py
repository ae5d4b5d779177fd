"""The table of commands: what each is called, its options, and the function that carries it out.

Options are light dataclasses. The function is named, not imported: what it needs is loaded when it runs.
"""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

import tyro

from taichi_mrf.cli.options.calibrate import Calibrate
from taichi_mrf.cli.options.config_file import laser_parameters, live_parameters, mapping_parameters
from taichi_mrf.cli.options.doctor import Doctor
from taichi_mrf.cli.options.laser import Laser
from taichi_mrf.cli.options.live import Demo, Live
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.options.measure import Bench, Eval
from taichi_mrf.cli.options.saved_maps import Diff, Export, Import, Info, Merge
from taichi_mrf.cli.options.tune import Tune


@dataclass(frozen=True)
class Command:
    """One command.

    ``options`` is the dataclass of its options, ``function`` "module:function", which takes them and returns
    the exit status. ``parameters`` reads the parameters that hold before any flag, if a file may name them.
    """

    options: type[Any]
    function: str
    parameters: Callable[[Sequence[str]], Any] | None = None
    brief: tuple[str, ...] = ()
    """The flags that --help explains; --help-all explains all. If it is empty, --help does so, too."""
    example: str = ""
    """A command that works everywhere, for the line that says what is wrong with another."""

    def defaults(self, arguments: Sequence[str]) -> Any:
        """The options before any flag; what the user must give is tyro.MISSING.

        Raises ConfigError if the file that the arguments name cannot be read.
        """
        required = {
            field.name: tyro.MISSING
            for field in fields(self.options)
            if field.default is field.default_factory is MISSING
        }
        if self.parameters is None:
            return tyro.MISSING_NONPROP if required else self.options()
        return self.options(**required, settings=self.parameters(arguments))

    def run(self, options: Any) -> int:
        """Import the function and call it. Raises TaichiMRFError."""
        module, _, name = self.function.partition(":")
        function: Callable[[Any], int] = getattr(importlib.import_module(module), name)
        return function(options)


_COMMON = ("out", "voxel-size", "method", "config", "every", "limit")
_MAP_EXAMPLE = "taichi-mrf map synthetic:room --out runs/room"
_MAP_FLAGS = (*_COMMON, "color", "noise", "resume", "overwrite", "jobs", "track-poses", "poses", "follow")
_LIVE_FLAGS = (
    *_COMMON,
    "overwrite",
    "speed",
    "track-poses",
    "poses",
    "follow",
    "time.half-life-s",
    "port",
    "open",
)
_TUNE_FLAGS = ("out", "voxel-size", "config", "frames", "first", "stride", "auto", "search", "port", "open")
_BENCH_FLAGS = (
    "voxel-sizes",
    "frames",
    "octomap",
    "json",
    "plot",
    "gate",
    "runtime.arch",
)

_LASER_FLAGS = (
    "out",
    "cell-size",
    "method",
    "config",
    "every",
    "limit",
    "compare",
    "no-returns",
    "no-return-range",
    "truth",
)

COMMANDS = {
    "map": Command(Map, "taichi_mrf.apps.batch:run_map", mapping_parameters, _MAP_FLAGS, _MAP_EXAMPLE),
    "live": Command(Live, "taichi_mrf.apps.live:run_live", live_parameters, _LIVE_FLAGS),
    "demo": Command(Demo, "taichi_mrf.apps.live:run_live", live_parameters, ("voxel-size", "port", "open")),
    "tune": Command(Tune, "taichi_mrf.apps.tune:run_tune", mapping_parameters, _TUNE_FLAGS),
    "export": Command(Export, "taichi_mrf.cli.export:run_export"),
    "import": Command(Import, "taichi_mrf.cli.import_map:run_import"),
    "diff": Command(Diff, "taichi_mrf.cli.diff:run_diff"),
    "merge": Command(Merge, "taichi_mrf.cli.merge:run_merge"),
    "info": Command(Info, "taichi_mrf.cli.info:run_info"),
    "doctor": Command(Doctor, "taichi_mrf.cli.doctor:run_doctor"),
    "bench": Command(Bench, "taichi_mrf.cli.bench:run_bench", None, _BENCH_FLAGS),
    "calibrate": Command(Calibrate, "taichi_mrf.cli.calibrate:run_calibrate"),
    "eval": Command(Eval, "taichi_mrf.cli.eval:run_eval"),
    "laser": Command(Laser, "taichi_mrf.cli.laser:run_laser", laser_parameters, _LASER_FLAGS),
}
"""Every command by name, in the order of the help."""
