"""Makes the figure of docs/how_it_works.md: the messages of one ray to its voxels, and marginals along a ray
through a wall that is seen again and again.

    python docs/make_how_it_works.py
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import taichi_mrf as tm

PICTURE = Path(__file__).resolve().parent / "images" / "how_it_works.png"
VOXEL_M = 0.05
WALL_M = 2.475
"""Depth of the wall, the centre of a voxel."""

COUNTS = (1, 3, 10)
"""Keyframes after which the marginals are read."""

CAMERA = tm.PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
SIGMA_M = 0.05
NOISE = tm.PolynomialNoise(sigma=(SIGMA_M,))  # one voxel, so that the ray's doubt shows
ALONG_M = np.arange(VOXEL_M / 2, 3.5, VOXEL_M)
"""Depths of the centres of the voxels along the ray."""


def main() -> None:
    """Draw both panels."""
    tm.init("cpu")
    figure = Figure(figsize=(10.0, 3.4), layout="constrained")
    first, second = figure.subplots(1, 2)
    message = one_ray()
    first.bar(ALONG_M, message, 0.8 * VOXEL_M, color=np.where(message > 0, "#c44e52", "#4c72b0"))
    first.set(title="Messages of one ray", ylabel="log-odds for occupied")
    for count, marginal in noisy_wall(tm.MRFMap(VOXEL_M, noise=NOISE)).items():
        second.plot(ALONG_M, marginal, ".-", label=f"{count} keyframe{'s' * (count > 1)}")
    last = noisy_wall(tm.LogOddsMap(VOXEL_M))[COUNTS[-1]]
    second.plot(ALONG_M, last, ".:", color="0.6", label=f"OctoMap's update, {COUNTS[-1]}", zorder=0)
    second.set(title="Marginals along a ray", ylabel="probability of occupied", ylim=(0, 1))
    second.legend(loc="upper left", fontsize=8)
    for axes, place in ((first, "measured depth"), (second, "true wall")):
        axes.axvline(WALL_M, color="0.4", linestyle="--", linewidth=1, zorder=0)
        axes.set(xlabel=f"metres from the camera; dashed: {place}", xlim=(1.5, 3.5))
    figure.savefig(PICTURE, dpi=90)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")


def one_ray() -> NDArray[np.float64]:
    """Votes of one ray alone on each of its voxels: the log-odds of its map less the prior's."""
    m = tm.MRFMap(VOXEL_M, noise=NOISE)
    one_pixel = tm.PinholeCamera(width=1, height=1, fx=70.0, fy=70.0, cx=0.0, cy=0.0)
    m.add_keyframe([[WALL_M]], along_a_row_of_voxels(), one_pixel)
    m.infer()
    return log_odds(marginals(m)) - log_odds(marginals(m)[-1])


def noisy_wall(m: tm.MRFMap | tm.LogOddsMap) -> dict[int, NDArray[np.float64]]:
    """The probabilities along one ray after each of the COUNTS, of keyframes with the sensor's noise."""
    random, after = np.random.default_rng(0), {}
    for count in range(1, max(COUNTS) + 1):
        depth_m = random.normal(WALL_M, SIGMA_M, CAMERA.shape)
        m.add_keyframe(depth_m.astype(np.float32), along_a_row_of_voxels(), CAMERA)
        if count in COUNTS:
            m.infer()
            after[count] = marginals(m)
    return after


def marginals(m: tm.MRFMap) -> NDArray[np.float64]:
    points = np.full((len(ALONG_M), 3), VOXEL_M / 2)
    points[:, 2] = ALONG_M
    return m.marginals.occupancy(points).astype(float)


def log_odds(p: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.log(p / (1 - p))


def along_a_row_of_voxels() -> NDArray[np.float64]:
    """The pose of a camera whose axis runs through the centres of the voxels."""
    pose = np.eye(4)
    pose[:2, 3] = VOXEL_M / 2
    return pose


if __name__ == "__main__":
    main()
