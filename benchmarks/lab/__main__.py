"""``python -m benchmarks.lab NAME --data DIR``: an experiment, with the flags of `taichi-mrf eval`."""

import sys

import tyro

from taichi_mrf.cli.eval import run_eval
from taichi_mrf.cli.options.measure import Eval
from taichi_mrf.evaluation.experiments.run import Entry

EXPERIMENTS = {
    "poses": Entry("benchmarks.lab.poses:run_poses", (0.05,)),
    "doubt": Entry("benchmarks.lab.doubtful_poses:run_doubt", (0.05,)),
    "rays": Entry("benchmarks.lab.rays:run_rays", (0.05, 0.02, 0.01)),
    "readings": Entry("benchmarks.lab.readings:run_readings", (0.05, 0.02)),
    "cells": Entry("benchmarks.lab.cells:run_cells", (0.05, 0.02)),
    "promise": Entry("benchmarks.lab.promise:run_promise", (0.05, 0.02), has_parts=True),
    "early": Entry("benchmarks.lab.early:run_early", (0.05, 0.02), has_parts=True),
    "endless": Entry("benchmarks.lab.endless:run_endless", (0.1,)),
    "changes": Entry("benchmarks.lab.changes:run_changes", (0.05, 0.02), needs_data=False),
    "submaps": Entry("benchmarks.lab.submaps.corridor:run_submaps", (0.05,), needs_data=False),
    "surface": Entry("benchmarks.lab.surface:run_surface", (0.05, 0.02, 0.01)),
    "lidar": Entry("benchmarks.lab.lidar:run_lidar", (0.2, 0.1, 0.05)),
    "located": Entry("benchmarks.lab.located:run_located", (0.05,)),
    "noise": Entry("benchmarks.lab.noise:run_noise", (), has_parts=True),
    "sensors": Entry("benchmarks.lab.sensors:run_sensors", (0.05,), needs_data=False),
    "trajectory": Entry("benchmarks.lab.trajectory.tables:run_trajectory", (0.05,), has_parts=True),
    "window": Entry("benchmarks.lab.window:run_window", (0.1,), needs_data=False),
    "wire": Entry("benchmarks.lab.wire:run_wire", (), has_parts=True),
}

if __name__ == "__main__":
    sys.exit(run_eval(tyro.cli(Eval, prog="python -m benchmarks.lab"), EXPERIMENTS))
