"""Cost of a wrong noise file, and the rest of it where sigma is learnt from the recording.

Every map of a recording is judged by the same held-out measurements under the same two noises: the given one,
and the one that was learnt from the mapped views.
"""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.lab.learnt_noise import learnt_law, noise_key, with_law
from benchmarks.lab.noise_scenes import NoiseCase, cases
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.depth_intervals import interval_error, view_below
from taichi_mrf.evaluation.experiments.contenders import Contender, row_name, wavemap
from taichi_mrf.evaluation.experiments.folds import Experiment, require_views
from taichi_mrf.evaluation.experiments.judging import build
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.evaluation.experiments.tuning import tuned_contender
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table
from taichi_mrf.sensor.noise import NoiseModel

GIVEN, AUTO = "MRFMap, given noise", "MRFMap, --noise auto"

JUDGED = 12
"""Held-out views that are judged, at most, evenly spread."""

COLUMNS = {
    "1.5sigma": "1.5 voxels",
    "5cm": "5 cm",
    "given": "log-likelihood, given noise",
    "learnt": "log-likelihood, learnt noise",
    "given calibration": "calibration, given noise",
    "learnt calibration": "calibration, learnt noise",
}
"""Figure -> heading."""


def run_noise(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """A row for each recording, voxel size and map. Raises ConfigError if ``only`` leaves none."""
    wanted = [case for case in cases() if experiment.wants(case.name)]
    if not wanted:
        raise ConfigError(f"--only leaves none of: {'; '.join(case.name for case in cases())}")
    rows: list[list[Entry]] = []
    notes = [
        "Share of held-out pixels whose likeliest surface lies within 1.5 voxels or 5 cm of the measured or "
        "true depth; log-likelihood of the measurements in nats, density per metre; calibration: mean "
        "difference between the probability of central intervals and the share of measurements in them."
    ]
    for case in wanted:
        scene = case.take(experiment)
        require_views(scene, 6)
        for voxel_size in experiment.voxel_sizes or case.voxel_sizes:
            found, note = _of_scene(experiment, case, scene, voxel_size)
            rows += found
            notes.append(note)
    table = Table(
        "noise", "Given and learnt noise", ["recording", "voxels", "map", *COLUMNS.values()], rows, notes
    )
    return [table], write_table(experiment.out, table)


def _of_scene(
    experiment: Experiment, case: NoiseCase, scene: Scene, voxel_size: float
) -> tuple[list[list[Entry]], str]:
    """The rows of a recording at a voxel size, and what was learnt."""
    keyframes, held_out = case.split(scene)
    held_out = held_out[:: max(1, -(-len(held_out) // JUDGED))]
    given = case.ours(GIVEN)
    experiment.report(f"learning the noise of {case.name}", 0, 1)
    law = learnt_law(experiment, given, scene, voxel_size, keyframes)
    learnt, where = with_law(scene, law), noise_key(scene, voxel_size)
    noises = {"given": scene.noise, "learnt": learnt.noise}
    maps = [
        (given, scene),
        (case.ours(AUTO, **law["prior"]), learnt),
        (tuned_contender(experiment, scene, 0, voxel_size, keyframes), scene),
        (wavemap(), scene),
    ]
    rows: list[list[Entry]] = []
    for number, (contender, assumed) in enumerate(maps):
        experiment.report(f"{contender.name}, {case.name}, {voxel_size * 100:g} cm", number, len(maps))
        result = experiment.ledger.result(
            f"{where} | {contender.name} ({contender.signature(assumed, voxel_size)}) | law {law}",
            lambda c=contender, s=assumed: _judged(c, s, voxel_size, keyframes, held_out, noises),  # type: ignore[misc]
        )
        for reading, figures in result["readings"].items():
            spreads = [Spread.of(figures[key]) for key in COLUMNS]
            rows.append([case.name, f"{voxel_size * 100:g} cm", row_name(contender.name, reading), *spreads])
    return rows, (
        f"{case.name}, {voxel_size * 100:g} cm: {law['scale']:.2f} times the given sigma and "
        f"{100 * law['added_m']:.2g} cm; a single factor {law['factor']:.2g}."
    )


def _judged(
    contender: Contender,
    scene: Scene,
    voxel_size: float,
    keyframes: Sequence[int],
    held_out: Sequence[int],
    noises: dict[str, NoiseModel],
) -> Result:
    """reading -> figure -> its value in each held-out view."""
    m, _ = build(contender, scene, voxel_size, keyframes)
    readings: dict[str, dict[str, list[float]]] = {}
    for reading, changes in contender.readings.items():
        figures: dict[str, list[float]] = {key: [] for key in COLUMNS}
        readings[reading] = figures
        view = m.view.with_occlusion(**changes) if changes else m.view
        for seen in (scene.views[i] for i in held_out):
            camera = seen.camera or scene.camera
            for name, noise in noises.items():
                judged = judge_view(
                    m, seen.true_m, seen.T_world_camera, camera, measured_m=seen.measured_m, noise=noise,
                    mask=seen.judged, view=view,
                )  # fmt: skip
                below = view_below(view, judged, seen.T_world_camera, camera)
                figures[name].append(judged.log_likelihood())
                figures[f"{name} calibration"].append(interval_error([below]))
            figures["1.5sigma"].append(judged.accuracy("1.5sigma").score)
            figures["5cm"].append(judged.accuracy("5cm").score)
    return {"readings": readings}
