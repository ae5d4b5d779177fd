"""Tables of maps' artefacts: beside each other at equal coverage, and under other definitions."""

from collections.abc import Mapping

from taichi_mrf.evaluation.artefacts import LEAST_RAYS, MAJORITY, SIGMAS
from taichi_mrf.evaluation.tables import Entry, Table
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.scenes import Scene
from taichi_mrf.experiments.stereo.artefact_curve import MAJORITIES, artefacts_at
from taichi_mrf.experiments.stereo.street import PASSES

COVERAGES = (0.9, 0.8, 0.7, 0.6)
"""Coverages at which maps are compared."""


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
