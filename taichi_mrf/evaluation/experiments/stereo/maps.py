"""Maps of stereo depth in the manner of Schauwecker & Zell's section IV: artefacts, growth, time, memory."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.artefacts import LEAST_RAYS, MAJORITY, SIGMAS, Sightings, sightings
from taichi_mrf.evaluation.bench import octomap_available
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.evaluation.experiments.stereo.growth import (
    MAJORITIES,
    OCTOMAP,
    STRIDES,
    artefacts_at,
    corridor_scene,
    curve,
    curve_figure,
    grow,
    growth_figure,
    growth_rows,
    measured_methods,
    scaling_figure,
    threshold_for,
    time_mapping,
    time_octomap,
)
from taichi_mrf.evaluation.experiments.stereo.street import (
    PASSES,
    Row,
    mrf_of_street,
    octomap_style,
    rows,
    street_scene,
    thinned,
    visibility,
    visibility_at_once,
)
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.own_evidence import OwnEvidence
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PICTURE_COVERAGE = 0.8
"""Share that the maps in the picture cover at least, if they can."""

DRAWN = ("OctoMap-style, Table I", "visibility map, at once", "MRFMap")

GROWTH_UPDATES: Mapping[float, int] = {0.1: 140, 0.2: 100, 0.4: 60}
"""Voxel size -> how often one image is integrated."""

GROWTH_EVERY = 2
GROWTH_ON_STREET = (0.2, 0.4)
SCALING_SIZES = (0.1, 0.2, 0.4)
SCALING_VIEWS = 3
COVERAGES = (0.9, 0.8, 0.7, 0.6)
"""Coverages at which maps are compared."""

PLAN_HEIGHTS_M = (-2.5, 4.0)
"""Range of the colours, metres above the first camera; a car carries its cameras at 1.7 m."""

ARTEFACT_COLOR = "#e6007e"
"""Magenta: on none of the colour scales."""


def run_stereo(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """All tables and pictures. Raises DatasetError or ConfigError if there is no recording to map."""
    whole = street_scene(experiment.data, experiment.limit)
    half = thinned(whole, 2)
    tables: list[Table] = []
    paths: list[Path] = []
    for voxel_size in experiment.voxel_sizes:
        some_tables, figures = _artefacts(experiment, half, voxel_size)
        tables += some_tables
        paths += _save(experiment, figures)
    for table, figure in (_growth(experiment, half), _scaling(experiment, whole)):
        tables.append(table)
        paths += _save(experiment, {table.name + "_curves": figure})
    return tables, [*(path for table in tables for path in write_table(experiment.out, table)), *paths]


def _save(experiment: Experiment, figures: "Mapping[str, Figure]") -> list[Path]:
    paths = []
    for name, figure in figures.items():
        paths.append(experiment.out / f"{name}.png")
        with atomic_path(paths[-1]) as temporary:
            figure.savefig(temporary, dpi=130)
    return paths


def _artefacts(
    experiment: Experiment, scene: Scene, voxel_size: float
) -> "tuple[list[Table], Mapping[str, Figure]]":
    """Every map against the views that it has not seen."""
    results: dict[str, Result] = {}
    everyone = rows()
    for number, row in enumerate(everyone):
        experiment.report(f"{row.name}, {voxel_size:g} m", number, len(everyone))
        results[row.name] = experiment.ledger.result(
            f"{scene.name} | {len(scene.views)} pairs | {row.name} "
            f"({row.contender.signature(scene, voxel_size)}) | {voxel_size:g} m",
            lambda r=row: _map_and_judge(r, scene, voxel_size),  # type: ignore[misc]
        )
    suffix = "" if len(experiment.voxel_sizes) == 1 else f"_{voxel_size * 1000:g}mm"
    tables = [
        artefact_table(f"stereo{suffix}", results, scene, voxel_size),
        majority_table(f"stereo_majority{suffix}", results),
    ]
    curves = {name: result["curve"] for name, result in results.items()}
    plans = {name: results[name]["plan"] for name in DRAWN}
    return tables, {
        f"stereo_artefacts{suffix}": curve_figure(curves, COVERAGES),
        f"stereo_plan{suffix}": plan_figure(plans, scene, voxel_size),
    }


def _map_and_judge(row: Row, scene: Scene, voxel_size: float) -> Result:
    start = time.perf_counter()
    m = row.build(scene, voxel_size)
    seconds = time.perf_counter() - start
    measured = (scene.views[1::2], scene.pinhole, scene.noise, scene.max_depth)
    seen = sightings(m, *measured, row.least_probability)
    swept = curve(seen, row.least_probability)
    threshold = swept["threshold"][threshold_for(swept, PICTURE_COVERAGE)]
    return {
        "curve": swept,
        "plan": plan(seen, scene, voxel_size, threshold),
        "build_seconds": seconds,
        "keyframes": len(m.keyframes),
        "log_likelihood": log_likelihood(m, row, scene),
    }


def log_likelihood(m: OccupancyMap, row: Row, scene: Scene) -> float:
    """Mean log density, per metre, of the held-out measurements under the map and its noise."""
    found = []
    for view in scene.views[1::2]:
        measured = np.where(view.measured_m <= scene.max_depth, view.measured_m, np.float32(0.0))
        own = OwnEvidence(None, view.sigma_m if row.pixel_sigma else None)
        noise = own.noise_model(scene.noise, measured)
        judged = judge_view(m, measured, view.T_world_camera, scene.camera, noise=noise, by="omega")
        found.append(judged.log_likelihood())
    return float(np.mean(found))


def _growth(experiment: Experiment, street: Scene) -> "tuple[Table, Figure]":
    """Fig. 5a."""
    corridor = corridor_scene(street.noise)
    panels: dict[str, dict[str, Result]] = {}
    for title, scene, sizes in (
        ("corridor", corridor, tuple(GROWTH_UPDATES)),
        (f"pair {street.views[0].name}", street, GROWTH_ON_STREET),
    ):
        panels[title] = {}
        for size in sizes:
            for contender, updates in ((visibility(), GROWTH_UPDATES[size]), (octomap_style(), 1)):
                experiment.report(f"growth, {title}, {size:g} m", len(panels[title]), 2 * len(sizes))
                panels[title][f"{contender.name}, {size:g} m"] = experiment.ledger.result(
                    f"{scene.name} | growth of {title} | {contender.name} "
                    f"({contender.signature(scene, size)}) | {size:g} m | {updates} updates",
                    lambda c=contender, s=scene, v=size, u=updates: grow(c, s, v, u, GROWTH_EVERY),  # type: ignore[misc]
                )
    distances = (5.0, 10.0, 15.0)
    columns = [
        "scene",
        "map",
        "m after 1",
        *(f"updates to {d:g} m" for d in distances),
        "updates",
        "m after all",
    ]
    notes = [
        "Distance of the farthest voxel with P(O) > 0.5 when one image is integrated again and again,",
        f"looked at after every {GROWTH_EVERY} updates. The paper: about 65 updates to 10 m at 0.2 m.",
    ]
    table = Table("stereo_fig5a", "Fig. 5a: growth", columns, growth_rows(panels, distances), notes, 1)
    return table, growth_figure(panels)


def _scaling(experiment: Experiment, whole: Scene) -> "tuple[Table, Figure]":
    """Figs. 5b and 5c."""
    contenders = [octomap_style(), visibility_at_once(), mrf_of_street()]
    methods = measured_methods(contenders)
    by_name = {each.name: each for each in contenders}
    results: dict[tuple[float, int, str], Result] = {}
    total = len(SCALING_SIZES) * len(STRIDES) * len(methods)
    for size in SCALING_SIZES:
        for stride in STRIDES:
            scene = thinned(whole, stride)
            for method in methods:
                experiment.report(f"timing {method}, {size:g} m", len(results), total)
                results[size, stride, method] = experiment.ledger.result(
                    f"{scene.name} | {len(scene.views)} pairs | time of {method} | {size:g} m | 1/{stride}",
                    lambda s=scene, v=size, n=method: (
                        time_octomap(s, v, SCALING_VIEWS)  # type: ignore[misc]
                        if n == OCTOMAP
                        else time_mapping(by_name[n], s, v, SCALING_VIEWS)
                    ),
                )
    lines: list[list[Entry]] = [
        [f"{size:g} m, {STRIDES[stride]}", method, r["seconds"], r["mb"], round(r["voxels"] / 1000)]
        for (size, stride, method), r in results.items()
    ]
    pairs = len(whole.views[: 2 * SCALING_VIEWS : 2])
    notes = [
        f"Medians over {pairs} pairs; after them, MB of voxels and messages, and thousands of known voxels.",
        "OctoMap's are nodes, which stand for many equal voxels; it runs on one thread.",
    ]
    if not octomap_available():
        notes.append("OctoMap is not installed: pip install 'taichi-mrf[bench]' adds it.")
    columns = ["voxels, resolution", "map", "seconds", "MB", "1000 known"]
    table = Table("stereo_fig5bc", "Figs. 5b, 5c: time and memory", columns, lines, notes, 3)
    return table, scaling_figure(results, methods)


def artefact_table(name: str, results: Mapping[str, Result], scene: Scene, voxel_size: float) -> Table:
    """One row for each map; the first is what the others are compared with."""
    baseline = next(iter(results.values()))["curve"]
    rows: list[list[Entry]] = []
    for row, result in results.items():
        swept = result["curve"]
        half = next(i for i, threshold in enumerate(swept["threshold"]) if threshold >= 0.5)
        line: list[Entry] = [row, swept["coverage"][half], swept["occupied"][half]]
        line.append(swept["artefacts"][f"{MAJORITY:g}"][half])
        for coverage in COVERAGES:
            found = artefacts_at(swept, coverage)
            line += [None if found is None else round(found), ratio(swept, baseline, coverage, MAJORITY)]
        rows.append([*line, result.get("log_likelihood"), result["build_seconds"]])
    columns = ["map", "coverage", "occupied", "artefacts"]
    for coverage in COVERAGES:
        columns += [f"at {coverage:g}", f"ratio at {coverage:g}"]
    notes = [
        f"{scene.name}: {len(scene.views[::2])} stereo pairs mapped at half resolution up to "
        f"{scene.max_depth:g} m, {len(scene.views[1::2])} held out.",
        "The first three figures are at P(O) >= 0.5, the others at equal coverage, with the ratio to the "
        "first row; a dash: no threshold gives that.",
        f"Artefact: of at least {LEAST_RAYS} held-out rays that pass or confirm an occupied voxel, at least "
        f"{MAJORITY:.0%} measure a surface more than {SIGMAS:g} sigma behind it.",
        f"Coverage: held-out measurements with an occupied voxel on their ray within {SIGMAS:g} sigma and a "
        "voxel size.",
        "Log-likelihood: mean log density, per metre, of the held-out measurements under the map and the "
        "noise that it was made with.",
        f"'{PASSES} passes': the pairs are integrated one after the other, and that {PASSES} times. "
        "'At once': unknown voxels stop no ray.",
    ]
    title = f"Artefacts of stereo maps, {voxel_size:g} m"
    return Table(name, title, [*columns, "log-likelihood", "seconds"], rows, notes, 2)


def majority_table(name: str, results: Mapping[str, Result]) -> Table:
    """The ratio to the first row under milder and stricter majorities."""
    baseline = next(iter(results.values()))["curve"]
    cases = [(majority, coverage) for majority in MAJORITIES for coverage in COVERAGES[:2]]
    rows: list[list[Entry]] = [
        [row, *(ratio(result["curve"], baseline, coverage, majority) for majority, coverage in cases)]
        for row, result in results.items()
    ]
    columns = ["map", *(f"{majority:.0%} of rays, at {coverage:g}" for majority, coverage in cases)]
    notes = ["Artefacts in relation to those of the first row, by the share of rays that makes one."]
    return Table(name, "What counts as seen through", columns, rows, notes, 2)


def ratio(swept: Result, baseline: Result, coverage: float, majority: float) -> float | None:
    """Artefacts of one curve for one of the baseline's; None if either has none to compare."""
    found = artefacts_at(swept, coverage, majority)
    theirs = artefacts_at(baseline, coverage, majority)
    return found / theirs if found is not None and theirs else None


def plan(seen: Sightings, scene: Scene, voxel_size: float, occupied_from: float) -> Result:
    """The columns of occupied voxels in the frame of the first camera, which looks ahead along a level
    street: ``ahead`` and ``right`` in voxels, ``top`` the height of the highest one in metres, and whether
    any is an ``artefact``."""
    T = scene.views[0].T_world_camera
    occupied = seen.probability >= occupied_from
    right, down, ahead = ((seen.centres[occupied] - T[:3, 3]) @ T[:3, :3]).T
    cells = np.floor(np.stack([ahead, right], axis=1) / voxel_size).astype(np.int64)
    columns, column_of = np.unique(cells, axis=0, return_inverse=True)
    column_of = column_of.reshape(-1)
    top = np.full(len(columns), -np.inf)
    np.maximum.at(top, column_of, -down)
    artefact = np.zeros(len(columns), bool)
    np.logical_or.at(artefact, column_of, seen.artefacts()[occupied])
    return {
        "ahead": columns[:, 0].tolist(),
        "right": columns[:, 1].tolist(),
        "top": [round(float(t), 1) for t in top],
        "artefact": artefact.astype(int).tolist(),
        "artefacts": int(seen.artefacts()[occupied].sum()),
        "coverage": seen.coverage(occupied_from),
        "occupied_from": occupied_from,
    }


def plan_figure(plans: Mapping[str, Result], scene: Scene, voxel_size: float) -> "Figure":
    """A panel for each map, the street ahead to the right; artefacts are drawn larger than they are."""
    from matplotlib import colormaps

    ahead = np.concatenate([np.asarray(p["ahead"], float) for p in plans.values()])
    right = np.concatenate([np.asarray(p["right"], float) for p in plans.values()])
    if not len(ahead):
        ahead = right = np.zeros(1)
    # A few far voxels would make all others small.
    (x_low, x_high), (y_low, y_high) = (np.quantile(v, [0.002, 0.998]) for v in (ahead, right))
    shape = (int(y_high - y_low) + 1, int(x_high - x_low) + 1)
    extent = (x_low * voxel_size, (x_high + 1) * voxel_size, (y_high + 1) * voxel_size, y_low * voxel_size)
    height_in = max(1.2, 11.0 * shape[0] / shape[1])
    figure = new_figure(12.5, (height_in + 0.45) * len(plans) + 0.6)
    axes_of_all = figure.subplots(len(plans), 1, squeeze=False, sharex=True)[:, 0]
    T = scene.views[0].T_world_camera
    camera_path = np.array([(view.T_world_camera[:3, 3] - T[:3, 3]) @ T[:3, :3] for view in scene.views[::2]])
    for axes, (name, drawn) in zip(axes_of_all, plans.items(), strict=True):
        image = np.full(shape, np.nan)
        row = (np.asarray(drawn["right"], float) - y_low).astype(int)
        column = (np.asarray(drawn["ahead"], float) - x_low).astype(int)
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        image[row[inside], column[inside]] = np.asarray(drawn["top"], float)[inside]
        shown = axes.imshow(
            image, extent=extent, cmap=colormaps["viridis"], vmin=PLAN_HEIGHTS_M[0], vmax=PLAN_HEIGHTS_M[1],
            interpolation="nearest",
        )  # fmt: skip
        wrong = inside & np.asarray(drawn["artefact"], bool)
        axes.plot(
            (np.asarray(drawn["ahead"])[wrong] + 0.5) * voxel_size,
            (np.asarray(drawn["right"])[wrong] + 0.5) * voxel_size,
            ".", color=ARTEFACT_COLOR, markersize=2.5,
        )  # fmt: skip
        axes.plot(camera_path[:, 2], camera_path[:, 0], "-", color="black", linewidth=1.0)
        axes.set(
            title=f"{name}: {drawn['artefacts']} artefacts (magenta) at P >= {drawn['occupied_from']:.2f}, "
            f"which covers {100 * drawn['coverage']:.0f} %",
            xlim=extent[:2], ylim=extent[2:],
        )  # fmt: skip
    axes_of_all[-1].set_xlabel("metres ahead; black: camera path")
    figure.colorbar(
        shown, ax=list(axes_of_all), location="bottom", shrink=0.5, aspect=40, pad=0.01,
        label="highest voxel (m above the camera)",
    )  # fmt: skip
    return figure
