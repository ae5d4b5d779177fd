"""`taichi-mrf eval price`: what dated evidence costs where nothing changes, on the scenes of Tables I to III.

One view in so many is held out and judged by the map of all others, static and dated. Views of recordings
have their recorded stamps; all others count as a second apart.
"""

from pathlib import Path

from taichi_mrf import MRFMap
from taichi_mrf.config.time import LIVE_HALF_LIFE_S, TimeConfig
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table
from taichi_mrf.experiments.contenders import Contender
from taichi_mrf.experiments.folds import Experiment, Scored, flatten, fold_key, require_views
from taichi_mrf.experiments.judging import build_and_judge
from taichi_mrf.experiments.scenes import Scene, coffin_scene, house_scene, kitchen_scene
from taichi_mrf.methods.protocol import OccupancyMap

HELD_OUT = {"coffin_world": 4, "house_livingroom": 10, "seven_scenes_redkitchen": 20}
"""One view in so many of each scene is held out, by its name."""

DATED = {"half-life 4 h (live)": TimeConfig(LIVE_HALF_LIFE_S), "half-life 10 min": TimeConfig(600.0)}
STATIC = "static"

FIGURES = ("1.5sigma", "5cm", "sensor")
"""Shares of pixels that are right; the price is in points of them."""

AIM_POINTS = 0.2


def run_price(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """The price of each half-life, for each scene and voxel size."""
    seed = experiment.seeds[0]
    scenes = [
        coffin_scene(experiment.data, seed),
        house_scene(experiment.data, seed),
        kitchen_scene(experiment.data),
    ]
    rows: list[list[Entry]] = []
    for scene in scenes:
        require_views(scene, 3)
        for size in experiment.voxel_sizes:
            static = _means(_judged(experiment, scene, size, STATIC, None))
            for name, time in DATED.items():
                dated = _means(_judged(experiment, scene, size, name, time))
                change = [100.0 * (dated[figure] - static[figure]) for figure in FIGURES]
                gain = dated["log_likelihood"] - static["log_likelihood"]
                met = min(change[:2]) >= -AIM_POINTS
                rows.append([scene.name, f"{size * 100:g} cm", name, *change, gain, "yes" if met else "no"])
    notes = [
        "Dated minus static, in points: shares of held-out pixels whose likeliest surface is right within "
        "1.5 voxels and within 5 cm of the truth, and whose noisy depth is within 1.5 sigma of it; and the "
        f"mean log-likelihood of a pixel, in nats. Aim: at most {AIM_POINTS:g} points lost by the first two.",
    ]
    columns = ["scene", "voxels", "map", "1.5sigma", "5cm", "noisy, sensor", "log-likelihood", "aim met"]
    table = Table("price", "What dated evidence costs where nothing changes", columns, rows, notes)
    return [table], list(write_table(experiment.out, table))


def contender(name: str, time: TimeConfig | None) -> Contender:
    """MRFMap with its defaults, and evidence that has a date unless ``time`` is None."""

    def make(scene: Scene, voxel_size: float) -> OccupancyMap:
        return MRFMap(voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, time=time)

    return Contender(f"MRFMap, {name}", make)


def _judged(
    experiment: Experiment, scene: Scene, voxel_size: float, name: str, time: TimeConfig | None
) -> list[Scored]:
    every, count = HELD_OUT[scene.name], len(scene.views)
    judged = list(range(min(every, count) // 2, count, every))
    others = [i for i in range(count) if i not in judged][: experiment.limit]
    who = contender(name, time)
    experiment.report(f"{scene.name}, {who.name}, {voxel_size * 100:g} cm", 0, 1)
    seed = experiment.seeds[0]
    result = experiment.ledger.result(
        fold_key(scene, seed, who, voxel_size, f"one in {every} held out, {len(others)} mapped"),
        lambda: build_and_judge(who, scene, voxel_size, others, judged),
    )
    return list(flatten(result, who.name, voxel_size, seed))


def _means(scored: list[Scored]) -> dict[str, float]:
    keys = (*FIGURES, "log_likelihood")
    return {key: Spread.of([each.figures[key] for each in scored]).mean for key in keys}
