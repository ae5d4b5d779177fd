"""The parameters that a command has before any flag: those of --config, or of the run to resume.

Flags change them, so that this file is read before the command line is parsed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from taichi_mrf.config.files import find_config, read_yaml
from taichi_mrf.config.schema import Config, load
from taichi_mrf.config.sections import LIVE_HALF_LIFE_S, TimeConfig
from taichi_mrf.config.values import from_dict
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.session.files import CONFIG_FILE


@dataclass(frozen=True)
class _Files:
    """The flags that name the file."""

    config: Path | None = None
    out: Path | None = None
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False


def mapping_parameters(arguments: Sequence[str]) -> Config:
    """The parameters of --config, with --resume those of the run in --out, else the defaults. Where none of
    them, nor a flag, gives a voxel size, it is to fit the recording. Raises ConfigError."""
    files = _files(arguments)
    path, config = files.config, Config()
    if path is None and files.resume and files.out is not None and (files.out / CONFIG_FILE).is_file():
        path = files.out / CONFIG_FILE
    if path is not None:
        config = load(path)
    flags = {word.partition("=")[0].replace("_", "-") for word in arguments}
    given = "--voxel-size" in flags or (path is not None and "voxel_size" in _values(path))
    return replace(config, fit_voxel_size=not given)


def live_parameters(arguments: Sequence[str]) -> Config:
    """The parameters for a live run, whose world changes, unless the file sets ``time.half_life_s``. Raises
    ConfigError."""
    path, config = _files(arguments).config, mapping_parameters(arguments)
    if path is not None and "half_life_s" in (_values(path).get("time") or {}):
        return config
    return replace(config, time=replace(config.time, half_life_s=LIVE_HALF_LIFE_S))


def live_defaults() -> Config:
    """The parameters of a live run without any file or flag."""
    return Config(time=TimeConfig(half_life_s=LIVE_HALF_LIFE_S))


def laser_parameters(arguments: Sequence[str]) -> LaserConfig:
    """The parameters of --config, else the defaults. Raises ConfigError."""
    files = _files(arguments)
    return LaserConfig() if files.config is None else load_laser_config(files.config)


def load_laser_config(path: Path) -> LaserConfig:
    """Read a YAML file of parameters. Raises ConfigError."""
    return from_dict(LaserConfig, read_yaml(path), str(path))


def _values(path: Path) -> dict[str, Any]:
    """The values of a file that has been read without errors."""
    return read_yaml(find_config(path)) or {}


def _files(arguments: Sequence[str]) -> _Files:
    return tyro.cli(_Files, args=list(arguments), return_unknown_args=True, add_help=False)[0]
