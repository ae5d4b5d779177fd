"""Poses that are slightly wrong: what they cost, and how much of it alignment takes back.

Every second view is mapped, the others are held out. In the simulated scenes the mapped views' poses are
disturbed; the first stays true, because it fixes the frame in which held-out views are judged at their true
poses. The recording's poses, those of held-out views included, are as wrong as they were recorded.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf import PinholeCamera, PolynomialNoise
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.config.schema import PoseConfig, VolumeConfig
from taichi_mrf.datasets.synthetic.room import RoomOptions, SyntheticRoom
from taichi_mrf.evaluation.experiments.contenders import mrf
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import judge_all
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView, house_scene, kitchen_scene
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.mapping.rounds import AlignmentRounds, PlainMover
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.simulate import KINECT_1

DISTURBED_M, DISTURBED_RAD = 0.02, np.radians(1.0)
"""Standard deviation of the disturbance along and about each axis of the camera."""

RECORDED, DISTURBED = "recorded", "disturbed"
TRUE = "true"
REFINED = PoseConfig(refine=True)

COLUMNS = {
    "1.5sigma": "1.5sigma",
    "5cm": "5cm",
    "median_abs": "median error (m)",
    "log_likelihood": "log-likelihood",
}
"""Figure of a held-out view -> heading."""

NOTES = (
    "Off: mean distance of the mapped views but the first from their true poses, in the recording from the "
    "recorded ones.",
    "Accuracy: mean over held-out views and seeds of the disturbance. 1.5sigma = within 1.5 voxels, 5cm = "
    "within 5 cm.",
    "Room and house: held-out views at their true poses; the first mapped view is true and fixes the frame.",
    "Recording: at recorded poses, which are wrong as well, and (views aligned) where they fit the map.",
)


@dataclass(frozen=True)
class Case:
    """A map to be made: where its keyframes stand at first, whether they are refined, and whether the views
    that judge it are aligned with it as well."""

    poses: str
    refined: bool = False
    views_aligned: bool = False
    seed: int = 0

    @property
    def name(self) -> str:
        words = [self.poses, *(["refined"] if self.refined else [])]
        return ", ".join([*words, *(["views aligned"] if self.views_aligned else [])])


def run_poses(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Pose error and held-out accuracy with true, disturbed and refined poses."""
    rows: list[list[Entry]] = []
    simulated = [Case(TRUE)]
    simulated += [Case(DISTURBED, refined, seed=s) for refined in (False, True) for s in experiment.seeds]
    real = [Case(RECORDED, refined, aligned) for aligned in (False, True) for refined in (False, True)]
    for voxel_size in experiment.voxel_sizes:
        for make, cases in ((room, simulated), (house, simulated), (kitchen, real)):
            scene = make(experiment)
            require_views(scene, 4)
            rows += _rows(experiment, scene, voxel_size, cases)
    columns = ["scene", "voxels", "poses", "off (cm)", "off (degrees)", *COLUMNS.values(), "map (s)", "maps"]
    table = Table("poses", "Poses that are slightly wrong", columns, rows, NOTES)
    return [table], write_table(experiment.out, table)


def room(experiment: Experiment) -> Scene:
    """The built-in room, seen by a Kinect 1."""
    dataset = SyntheticRoom("synthetic_room", RoomOptions().camera(), color=False)
    views = []
    for index in range(len(dataset))[: experiment.limit]:
        frame, clean = dataset.read(index), dataset.clean_depth(index)
        views.append(SceneView(frame.name, frame.T_world_camera, frame.depth_m, clean, clean > 0))
    noise = PolynomialNoise(KINECT_1.sigma, KINECT_1.bias)
    return Scene(dataset.name, dataset.camera, noise, VolumeConfig(), 10.0, views)


def house(experiment: Experiment) -> Scene:
    """The living room with a Kinect 1's noise, at half its resolution."""
    return halved(house_scene(experiment.data, limit=experiment.limit))


def kitchen(experiment: Experiment) -> Scene:
    """The recording, at half its resolution."""
    return halved(kitchen_scene(experiment.data, limit=experiment.limit))


def halved(scene: Scene) -> Scene:
    """A scene by a camera with every second pixel along both axes."""
    k = scene.pinhole
    camera = PinholeCamera(-(-k.width // 2), -(-k.height // 2), k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)

    return replace(scene, camera=camera, views=[_halved(view) for view in scene.views])


def _halved(view: SceneView) -> SceneView:
    return replace(
        view,
        measured_m=view.measured_m[::2, ::2],
        true_m=view.true_m[::2, ::2],
        judged=view.judged[::2, ::2],
    )


def disturbed(poses: Sequence[Pose], seed: int) -> list[Pose]:
    """Poses with a Gaussian disturbance, the first as it is."""
    random = np.random.default_rng(seed)
    scale = np.repeat([DISTURBED_M, DISTURBED_RAD], 3)
    return [poses[0], *(moved(T, random.normal(0.0, scale)) for T in poses[1:])]


def build_and_judge(case: Case, scene: Scene, voxel_size: float) -> Result:
    """A map of every second view, judged on the others, with the errors of its poses."""
    mapped, held_out = range(0, len(scene.views), 2), range(1, len(scene.views), 2)
    true = [scene.views[i].T_world_camera for i in mapped]
    poses = disturbed(true, case.seed) if case.poses == DISTURBED else true
    begin = time.perf_counter()
    contender = mrf()
    m = contender.make(scene, voxel_size)
    assert can_refine_poses(m)
    refiner = PoseRefiner(m, REFINED)
    for index, T_world_camera in zip(mapped, poses, strict=True):
        view = scene.views[index]
        keyframe = m.add_keyframe(view.measured_m, T_world_camera, scene.camera, view.name)
        if case.refined:
            refiner.place(keyframe)
    if case.refined:
        AlignmentRounds(refiner, PlainMover(m)).run()
    m.infer()
    seconds = time.perf_counter() - begin
    errors = [tangent_norms(a, k.T_world_camera) for a, k in zip(true, m.keyframes.values(), strict=True)]
    rotation, translation = np.array(errors[1:]).T
    if case.views_aligned:
        scene = replace(scene, views=[aligned(m, scene, view) for view in scene.views])
    result = judge_all(m, seconds, contender, scene, held_out)
    return result | {"rotation_rad": rotation.tolist(), "translation_m": translation.tolist()}


def aligned(m: MRFMap, scene: Scene, view: SceneView) -> SceneView:
    """A view from where it fits the map, which stays as it is."""
    keyframe = m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
    T_world_camera = m.refine_pose(keyframe).T_world_camera
    m.remove_keyframe(keyframe)
    return replace(view, T_world_camera=T_world_camera)


def _rows(
    experiment: Experiment, scene: Scene, voxel_size: float, cases: Sequence[Case]
) -> list[list[Entry]]:
    """One row for each way to come by poses, whose cases differ in their seeds."""
    ways: dict[str, list[Result]] = {}
    for number, case in enumerate(cases):
        experiment.report(f"{scene.name}, {voxel_size * 100:g} cm, {case.name}", number, len(cases))
        key = fold_key(scene, 0, mrf(), voxel_size, f"{len(scene.views)} views, {case}, {REFINED}")
        result = experiment.ledger.result(key, partial(build_and_judge, case, scene, voxel_size))
        ways.setdefault(case.name, []).append(result)
    return [_row(scene, voxel_size, name, results) for name, results in ways.items()]


def _row(scene: Scene, voxel_size: float, name: str, results: Sequence[Result]) -> list[Entry]:
    views = [figures for result in results for figures in result["readings"][""].values()]
    centimetres = [100 * each for result in results for each in result["translation_m"]]
    degrees = [float(np.degrees(each)) for result in results for each in result["rotation_rad"]]
    return [
        scene.name,
        f"{voxel_size * 100:g} cm",
        name,
        Spread(Spread.of(centimetres).mean),
        Spread(Spread.of(degrees).mean),
        *(Spread(Spread.of([figures[key] for figures in views]).mean) for key in COLUMNS),
        Spread(Spread.of([result["build_seconds"] for result in results]).mean),
        len(results),
    ]
