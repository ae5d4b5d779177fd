"""Command ``taichi-mrf import``: read an OctoMap file, write it as a LogOddsMap, print its size."""

import dataclasses
import json

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.cli.options.saved_maps import Import
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.registry import octomap_method
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.map_file import MapHeader
from taichi_mrf.methods.recursive import RecursiveContents, write_recursive
from taichi_mrf.methods.recursive_update import LEAST_LOG_ODDS, UNKNOWN_LOG_ODDS
from taichi_mrf.sensor.noise import PolynomialNoise


def run_import(options: Import) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    if options.out.suffix.lower() != ".npz":
        raise ConfigError(f"{options.out}: --out must end in .npz")
    leaves = read_octomap(options.file)
    leaves = dataclasses.replace(leaves, log_odds=_known(leaves.log_odds))
    bricks, log_odds = leaves.bricks()
    config = Config(leaves.voxel_size, octomap_method().name)
    noise = PolynomialNoise(config.sensor.sigma, config.sensor.bias)
    contents = RecursiveContents(MapHeader(config, noise, [], 0), bricks, log_odds, stale=False)
    write_recursive(options.out, contents)
    facts = {
        "source": str(options.file),
        "map": str(options.out),
        "voxel_size": leaves.voxel_size,
        "leaves": len(leaves.code),
        "bricks": len(bricks),
        "occupied": int((log_odds > 0).sum()),
        "free": int((log_odds < 0).sum()),
    }
    if options.json:
        print(json.dumps(facts, indent=2))
        return 0
    console = Terminal()
    text = (
        f"{facts['leaves']:,} OctoMap leaves: {facts['occupied']:,} occupied and {facts['free']:,} free "
        f"voxels of {leaves.voxel_size:g} m in {facts['bricks']:,} bricks"
    )
    for line in (text, str(options.out)):
        console.print_line(line)
    return 0


def _known(log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Log-odds that mark no voxel as unknown, as methods/recursive_update.py has them: OctoMap knows a node
    of log-odds 0, and counts it as occupied."""
    return np.where(
        np.abs(log_odds - UNKNOWN_LOG_ODDS) < LEAST_LOG_ODDS, np.float32(LEAST_LOG_ODDS), log_odds
    )
