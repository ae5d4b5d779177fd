"""Makes docs/images/free.png: a layer of the room of benchmarks/thin.py, with what maps say of its posts.

    python docs/make_free_picture.py

Red are voxels that are called free, although a thing goes through them and ten measurements end in them.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

import taichi_mrf as tm
from taichi_mrf.queries.box import map_extent, read_box
from taichi_mrf.queries.points import classify

REPOSITORY = Path(__file__).resolve().parents[1]
PICTURE = REPOSITORY / "docs" / "images" / "free.png"
sys.path.insert(0, str(REPOSITORY))
from benchmarks.thin import configured, keys_of, map_views, truth_of  # noqa: E402
from benchmarks.thin_rooms import depth_camera, room, take_views  # noqa: E402

VOXEL_M, HEIGHT_M = 0.05, 0.23
VIEWS = 40
COLOURS = ("#d9d9d9", "#eef3f8", "#27415e", "#d62728")
"""Unknown, free, occupied, and free in spite of what is there."""

WRONG = 3


def main() -> None:
    """Map the room twice, and draw the layer three times."""
    tm.init("cpu")
    scene, defaults = room(0), tm.Config().sensor
    sensor = depth_camera(defaults.sigma, defaults.max_depth)
    views = take_views(scene, sensor, VIEWS, 0)
    truth = truth_of(scene, sensor, views, VOXEL_M)
    thin = np.concatenate([keys for kind, keys in truth.measured.items() if kind != "wall"])
    mrf, log_odds = (
        map_views(configured(method, VOXEL_M, sensor, False), sensor, views) for method in ("mrf", "log_odds")
    )
    lower_m, upper_m = map_extent(mrf)
    lower_m[2], upper_m[2] = HEIGHT_M - 0.01, HEIGHT_M + 0.01
    found = read_box(mrf, lower_m, upper_m)
    view = mrf.view
    by_marginals = classify(found.log_odds, view.pool.prior_log_odds, view.volume.min_evidence)
    figure = Figure(figsize=(12.0, 3.5), layout="constrained")
    panels = {
        "MRFMap by its marginals": by_marginals,
        "MRFMap": found.state,
        "Log-odds, as OctoMap": read_box(log_odds, lower_m, upper_m).state,
    }
    for axes, (title, state) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        shown, wrong = marked(state, np.array(found.lowest), thin)
        extent = (lower_m[0], upper_m[0], lower_m[1], upper_m[1])
        axes.imshow(
            shown, ListedColormap(COLOURS), vmin=0, vmax=WRONG, origin="lower", extent=extent,
            interpolation="nearest",
        )  # fmt: skip
        axes.set(title=f"{title}: {wrong} wrong", xlabel="metres")
    figure.savefig(PICTURE, dpi=90)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")


def marked(
    state: NDArray[np.int8], lowest: NDArray[np.int64], thin: NDArray[np.int64]
) -> tuple[NDArray[np.int8], int]:
    """A layer's states as an image, rows along y, with what is wrongly free, and how many voxels are."""
    cells = np.indices(state.shape).reshape(3, -1).T + lowest
    wrong = (state == tm.FREE) & np.isin(keys_of(cells), thin).reshape(state.shape)
    return np.where(wrong, WRONG, state)[:, :, 0].T.astype(np.int8), int(wrong.sum())


if __name__ == "__main__":
    main()
