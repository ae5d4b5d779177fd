"""MRFMap's Fig. 7: where each map is right, and what one ray meets in it."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.accuracy import NO_ANSWER, NOT_JUDGED, RIGHT, WRONG, JudgedView, judge_view
from taichi_mrf.evaluation.experiments.contenders import Contender, log_odds, mrf
from taichi_mrf.evaluation.experiments.folds import Experiment, require_views
from taichi_mrf.evaluation.experiments.judging import build
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView, coffin_scene
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.queries.view import RayProfile
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VIEW = 4
"""The view that is held out, in which the box stands before the floor and the walls."""

COLORS = {NOT_JUDGED: "#440154", NO_ANSWER: "#b0b0b0", WRONG: "#21918c", RIGHT: "#fde725"}
"""Purple, green and yellow as in the paper; grey where a ray meets nothing."""

NAMES = {NOT_JUDGED: "not judged", NO_ANSWER: "no answer", WRONG: "wrong", RIGHT: "right"}


def run_fig7(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One picture for each voxel size, with its figures."""
    scene = coffin_scene(experiment.data, experiment.seeds[0])
    require_views(scene, 3)
    held_out = min(VIEW, len(scene.views) - 1)
    view = scene.views[held_out]
    pixel = beside_an_edge(view)
    contenders = [mrf(), log_odds("OctoMap-style")]
    rows: list[list[Entry]] = []
    paths: list[Path] = []
    for voxel_size in experiment.voxel_sizes:
        judged: list[JudgedView] = []
        profiles: list[RayProfile] = []
        for number, contender in enumerate(contenders):
            experiment.report(f"{contender.name}, {voxel_size * 100:g} cm", number, len(contenders))
            training = [i for i in range(len(scene.views)) if i != held_out]
            m, _ = build(contender, scene, voxel_size, training)
            parts = (view.true_m, view.T_world_camera, scene.camera)
            judged.append(judge_view(m, *parts, mask=view.judged, by="omega"))
            profiles.append(m.ray_profile(view.T_world_camera[:3, 3], _direction(scene, view, pixel)))
            score = judged[-1].accuracy("1.5sigma")
            rows.append([f"{voxel_size * 100:g} cm", contender.name, score.score, score.unanswered])
        path = experiment.out / f"fig7_{voxel_size * 1000:g}mm.png"
        with atomic_path(path) as temporary:
            figure = _figure(scene, view, pixel, contenders, judged, profiles)
            figure.savefig(temporary, dpi=130)
        paths.append(path)
    table = Table(
        "fig7", f"Held-out {view.name}", ["voxels", "map", "1.5sigma", "unanswered"], rows,
        [f"The ray is that of pixel {pixel}, beside an edge that stands before a surface further on."],
    )  # fmt: skip
    return [table], [*write_table(experiment.out, table), *paths]


def beside_an_edge(view: SceneView) -> tuple[int, int]:
    """(u, v) of the judged pixel just beyond the largest step of depth in the middle of the image: its ray
    passes by the nearer surface on its way to the further one. Raises ConfigError if there is none."""
    height, width = view.true_m.shape
    depth = np.where(view.judged, view.true_m, np.nan)
    step = np.full((height, width), -np.inf)
    step[:, 3:] = depth[:, 3:] - depth[:, :-3]
    inner = np.zeros_like(step, bool)
    inner[height // 4 : -height // 4, width // 4 : -width // 4] = True
    step[~inner | ~np.isfinite(step)] = -np.inf
    v, u = np.unravel_index(int(step.argmax()), step.shape)
    if not np.isfinite(step[v, u]):
        raise ConfigError(f"{view.name}: no pixel in the middle of the image can be judged")
    return int(u), int(v)


def _direction(scene: Scene, view: SceneView, pixel: tuple[int, int]) -> NDArray[np.float64]:
    ray: NDArray[np.float64] = view.T_world_camera[:3, :3] @ scene.camera.rays()[pixel[1], pixel[0]]
    return ray


def _figure(
    scene: Scene,
    view: SceneView,
    pixel: tuple[int, int],
    contenders: Sequence[Contender],
    judged: Sequence[JudgedView],
    profiles: Sequence[RayProfile],
) -> "Figure":
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure = new_figure(6.2 * len(contenders), 9.0)
    axes = figure.subplots(2, len(contenders), squeeze=False, gridspec_kw={"height_ratios": (1.25, 1.0)})
    for column, (contender, seen, profile) in enumerate(zip(contenders, judged, profiles, strict=True)):
        score = seen.accuracy("1.5sigma")
        picture = axes[0, column]
        picture.imshow(
            score.image, cmap=ListedColormap(list(COLORS.values())), vmin=-0.5, vmax=3.5,
            interpolation="nearest",
        )  # fmt: skip
        picture.plot(*pixel, "o", markersize=11, markerfacecolor="none", markeredgecolor="red", mew=2)
        picture.set(xticks=[], yticks=[], title=f"{contender.name}: {100 * score.score:.1f} % right")
        _draw_profile(axes[1, column], scene, view, pixel, profile, seen.voxel_size)
    limits = [ax.get_xlim() for ax in axes[1]]
    for ax in axes[1]:
        ax.set_xlim(min(low for low, _ in limits), max(high for _, high in limits))
    figure.legend(
        handles=[Patch(color=COLORS[k], label=NAMES[k]) for k in (RIGHT, WRONG, NO_ANSWER, NOT_JUDGED)],
        loc="outside lower center", ncols=4, frameon=False,
    )  # fmt: skip
    figure.suptitle(
        f"{scene.name}, held-out {view.name}, voxels of {judged[0].voxel_size * 100:g} cm; "
        f"ray of pixel {pixel} (red circle)"
    )
    return figure


def _draw_profile(
    axes: "Axes",
    scene: Scene,
    view: SceneView,
    pixel: tuple[int, int],
    profile: RayProfile,
    voxel_size: float,
) -> None:
    """Probability, visibility and omega along the ray, by range, with the depths that matter as lines."""
    u, v = pixel
    per_depth = float(scene.pinhole.range_per_depth()[v, u])
    true, measured = (float(image[v, u]) * per_depth for image in (view.true_m, view.measured_m))
    begins = profile.distance - 0.5 * profile.length
    peak = float(profile.omega.max(initial=0.0)) or 1.0
    for values, color, label in (
        (profile.occupancy, "tab:green", "p_occ"),
        (profile.visibility, "tab:red", "vis"),
        (profile.omega / peak, "tab:blue", f"omega / {peak:.1f} per metre"),
    ):
        axes.step(begins, values, where="post", color=color, label=label)
    axes.axvspan(true - voxel_size, true + voxel_size, color="purple", alpha=0.15)
    axes.axvline(true, color="purple", label="true range and one sigma")
    if measured > 0:
        axes.axvline(measured, color="black", linestyle="--", label="measured range")
    if len(profile.omega):
        likeliest = float(profile.distance[profile.omega.argmax()])
        axes.axvline(likeliest, color="tab:blue", label="argmax omega")
    depths = [true, measured] if measured > 0 else [true]
    near = min(*depths, *(begins[profile.omega > 0.02 * peak].tolist() or [math.inf])) - 0.3
    axes.set(xlim=(near, max(depths) + 0.4), ylim=(-0.02, 1.05), xlabel="range (m)")
    axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    axes.grid(alpha=0.3)
