"""How long tune takes from a changed parameter to the first scores, and to the full ones.

    python benchmarks/first_scores.py FOLDER --voxel-size 0.05

Eight frames of a sequence make the map and four score it, as ``taichi-mrf tune`` chooses them; the prior is
changed from try to try, as by a slider. The first try, in which everything is compiled, does not count. What
the page takes to show a score comes on top.
"""

import statistics
import time
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import open_dataset
from taichi_mrf.system import runtime
from taichi_mrf.tune.trial import run_trial
from taichi_mrf.tune.working_set import coarse_stride, read_working_set
from taichi_mrf.viewer.tune.messages import FrameChoice


@dataclass(frozen=True)
class Options:
    """Arguments of the measurement."""

    source: Annotated[str, tyro.conf.Positional]
    """A recording or a built-in sequence."""

    voxel_size: float = 0.05
    """Metres."""

    tries: int = 5
    """Parameters that are tried after the first."""


def main() -> None:
    """Print the medians."""
    options = tyro.cli(Options, description=__doc__)
    runtime.init("cpu")
    frames = read_working_set(open_dataset(options.source), FrameChoice())
    first, full = [], []
    for number in range(options.tries + 1):
        config = Config(options.voxel_size)
        config = replace(config, inference=replace(config.inference, surface_density=2.0 + 0.1 * number))
        begin = time.perf_counter()
        run_trial(config, frames, pixel_stride=coarse_stride(frames.camera))
        first.append(time.perf_counter() - begin)
        run_trial(config, frames)
        full.append(time.perf_counter() - begin)
    print(
        f"{len(frames.training)} frames of {frames.camera.width} x {frames.camera.height} mapped at "
        f"{options.voxel_size * 100:g} cm, {len(frames.held_out)} judged; medians of {options.tries}: "
        f"first scores after {statistics.median(first[1:]):.2f} s, full ones after "
        f"{statistics.median(full[1:]):.2f} s"
    )


if __name__ == "__main__":
    main()
