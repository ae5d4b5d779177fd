"""Loss of a keyframe whose pixels do not each have a ray of their own, and its gain in time.

On every scene the same views are mapped with every pixel, with bundles and with thinned pixels
(inference/ray_list.py), and judged by the same held-out views.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_mrf.evaluation.experiments.contenders import Contender, mrf
from taichi_mrf.evaluation.experiments.exact import room_scene
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import build_and_judge
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, coffin_scene, house_scene, kitchen_scene
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVERY_PIXEL = mrf("every pixel", ray_density=0.0)
WANTED = (0.5, 1.0, 2.5, 5.0)
"""Rays a voxel for each centimetre of its side."""

VIEWS = 12
"""Of each scene, evenly spread, or as many as it has; every JUDGED-th is kept out and judged."""

JUDGED = 6

FIGURES = ("1.5sigma", "5cm", "sensor")


@dataclass(frozen=True)
class _Point:
    """One map: its mean figures over the judged views, and the seconds a keyframe took, sweeps and all."""

    contender: str
    scene: str
    voxel_size: float
    figures: dict[str, float]
    seconds: float


def ray_contenders() -> Sequence[Contender]:
    """Every pixel, and each choice of rays."""
    return [EVERY_PIXEL, *(mrf(f"bundles, {n:g} per cm", ray_density=n) for n in WANTED)]


def run_rays(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """The table, and accuracy against time for each voxel size."""
    views = min(VIEWS, experiment.limit or VIEWS)
    scenes: tuple[Callable[[], Scene], ...] = (
        lambda: coffin_scene(experiment.data),
        lambda: house_scene(experiment.data),
        lambda: kitchen_scene(experiment.data),
        lambda: room_scene(views),
    )
    points = []
    for make in scenes:
        scene = make()
        require_views(scene, JUDGED)
        chosen = spread(len(scene.views), views)
        for voxel_size in experiment.voxel_sizes:
            points += _scene_points(experiment, scene, voxel_size, chosen)
    table = _table(points)
    paths = write_table(experiment.out, table)
    path = experiment.out / "rays_curve.png"
    with atomic_path(path) as part:
        rays_figure(points).savefig(part, format="png", dpi=110)
    return [table], [*paths, path]


def spread(count: int, wanted: int) -> list[int]:
    """Up to ``wanted`` of the numbers below ``count``, evenly spread."""
    return sorted({i * count // min(wanted, count) for i in range(min(wanted, count))})


def _scene_points(
    experiment: Experiment, scene: Scene, voxel_size: float, chosen: Sequence[int]
) -> list[_Point]:
    judged = list(chosen[JUDGED // 2 :: JUDGED])
    keyframes = [i for i in chosen if i not in judged]
    points, contenders = [], ray_contenders()
    for number, contender in enumerate(contenders):
        experiment.report(f"{scene.name}, {contender.name}, {voxel_size * 100:g} cm", number, len(contenders))
        result = experiment.ledger.result(
            fold_key(scene, 0, contender, voxel_size, f"{len(chosen)} views"),
            lambda c=contender: build_and_judge(c, scene, voxel_size, keyframes, judged),  # type: ignore[misc]
        )
        points.append(_point(scene, contender, voxel_size, result, len(keyframes)))
    return points


def _point(scene: Scene, contender: Contender, voxel_size: float, result: Result, keyframes: int) -> _Point:
    views = result["readings"][""].values()
    figures = {name: sum(view[name] for view in views) / len(views) for name in (*FIGURES, "median_abs")}
    return _Point(contender.name, scene.name, voxel_size, figures, result["build_seconds"] / keyframes)


def _table(points: Sequence[_Point]) -> Table:
    """Accuracies, and how far below every pixel's the worst of them is, in points of 100."""
    base = {(p.scene, p.voxel_size): p for p in points if p.contender == EVERY_PIXEL.name}
    rows: list[list[Entry]] = []
    for p in points:
        reference = base[p.scene, p.voxel_size]
        worst = max(100 * (reference.figures[name] - p.figures[name]) for name in FIGURES)
        costs: list[Entry] = [100 * p.figures["median_abs"], p.seconds, p.seconds / reference.seconds]
        accuracies = [p.figures[name] for name in FIGURES]
        rows.append([p.contender, p.scene, f"{p.voxel_size * 100:g} cm", *accuracies, worst, *costs])
    return Table(
        "rays",
        "Accuracy and time by the choice of rays",
        ["rays", "scene", "voxels", *FIGURES, "points lost", "median error, cm", "s a keyframe", "of all"],
        rows,
        ["Points lost: of the three accuracies the one that falls most below every pixel's."],
    )


def rays_figure(points: Sequence[_Point]) -> "Figure":
    """Accuracy against time, one panel for each voxel size; a line for each scene and choice."""
    sizes = sorted({p.voxel_size for p in points}, reverse=True)
    scenes = sorted({p.scene for p in points})
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    figure = new_figure(5.0 * len(sizes), 4.4)
    for axes, size in zip(figure.subplots(1, len(sizes), squeeze=False)[0], sizes, strict=True):
        for color, scene in enumerate(scenes):
            here = [p for p in points if p.scene == scene and p.voxel_size == size]
            for kind, style in (("bundles", "o-"), ("thinned", "x:")):
                line = [p for p in here if p.contender.startswith((kind, EVERY_PIXEL.name))]
                line.sort(key=lambda p: p.seconds)
                accuracy = [p.figures["5cm"] for p in line]
                axes.plot(
                    [p.seconds for p in line], accuracy, style, color=f"C{color}", label=f"{scene}, {kind}"
                )
        axes.set(xscale="log", xlabel="s a keyframe, three sweeps", title=f"{size * 100:g} cm")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("pixels within 5 cm")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=7
    )
    return figure
