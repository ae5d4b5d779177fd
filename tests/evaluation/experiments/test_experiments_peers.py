"""The comparison with every peer: scores in closed form, each peer on a wall, the whole on small scenes."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from small_scenes import CAMERA

from taichi_mrf import PinholeCamera, PolynomialNoise
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.bench import octomap_available
from taichi_mrf.evaluation.experiments.peers import cases, our_maps, run
from taichi_mrf.evaluation.experiments.peers.cases import (
    FREE_A_PIXEL,
    RIGHT,
    Case,
    KnownPoints,
    along_rays,
    answer_scores,
    cell_scores,
    measured,
)
from taichi_mrf.evaluation.experiments.peers.peer import Answers, Cells, Knob, Peer, System, thinned
from taichi_mrf.evaluation.experiments.peers.run import Point, frontier
from taichi_mrf.evaluation.experiments.peers.systems import OctomapPeer, TsdfPeer, systems
from taichi_mrf.evaluation.experiments.run import EXPERIMENTS, run_experiment
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView

pytestmark = pytest.mark.usefixtures("one_backend")

WALL_M = 1.93
VOXEL_M = 0.1

needs_octomap = pytest.mark.skipif(
    not octomap_available(), reason="pyoctomap (the extra bench) is not installed"
)


def wall(views: int = 4) -> Scene:
    """A wall across the axis of a camera that does not turn and moves a little sideways."""
    depth_m = np.full(CAMERA.shape, WALL_M, np.float32)
    poses = [np.eye(4) for _ in range(views)]
    for number, pose in enumerate(poses):
        pose[0, 3] = 0.02 * number
    found = [SceneView(f"{i}", pose, depth_m, depth_m, depth_m > 0) for i, pose in enumerate(poses)]
    return Scene("wall", CAMERA, PolynomialNoise((0.01,)), VolumeConfig(), 5.0, found)


def wall_case(scene: Scene) -> Case:
    return Case(scene, VOXEL_M, [0, 1, 2], [3], along_rays(scene, [3], VOXEL_M), None)


def mapped(peer: Peer, scene: Scene) -> Peer:
    for view in scene.views[:3]:
        peer.integration(view)()
    peer.conclude()
    return peer


def test_answers_are_scored_in_closed_form() -> None:
    view = wall().views[0]
    depth_m = view.true_m.astype(np.float64)
    depth_m[0] = np.nan
    depth_m[1] += 0.149
    depth_m[2] -= 0.151
    depth_m[3] += 0.049
    scores = answer_scores(Answers(depth_m, -1.5), view, wall_case(wall()))
    rows = CAMERA.height
    assert scores[RIGHT] == pytest.approx(1 - 2 / rows)
    assert scores["within 5 cm"] == pytest.approx(1 - 3 / rows)
    assert scores["unanswered"] == pytest.approx(1 / rows)
    assert scores["log-likelihood"] == -1.5


def test_states_are_scored_in_closed_form() -> None:
    truth = KnownPoints(np.zeros((8, 3)), np.array([True] * 4 + [False] * 4))
    called = np.array([True, True, False, False, True, False, False, False])
    free = np.array([False, False, True, False, False, True, True, False])
    scores = cell_scores(Cells(np.where(called, 0.75, 0.25), called, free), truth)
    assert scores["occupied precision"] == pytest.approx(2 / 3)
    assert scores["occupied recall"] == pytest.approx(2 / 4)
    assert scores["free precision"] == pytest.approx(2 / 3)
    assert scores["free recall"] == pytest.approx(2 / 4)
    # 3 points of 0.75 of which 2 are occupied, 5 of 0.25 of which 2 are
    assert scores["calibration error"] == pytest.approx((3 * (0.75 - 2 / 3) + 5 * (2 / 5 - 0.25)) / 8)


def test_points_along_rays_are_free_in_front_of_the_wall_alone() -> None:
    scene = wall()
    known = along_rays(scene, [3], VOXEL_M)
    assert np.allclose(known.points_m[known.occupied][:, 2], WALL_M)
    free_z = known.points_m[~known.occupied][:, 2]
    assert free_z.max() <= WALL_M - 2 * VOXEL_M
    assert free_z.min() >= 0
    assert len(free_z) == FREE_A_PIXEL * known.occupied.sum()


def test_a_thinned_view_keeps_the_rays_of_its_pixels() -> None:
    scene = wall()
    view = thinned(scene.views[0], scene, 4)
    assert view.camera is not None
    assert view.measured_m.shape == view.camera.shape
    assert np.allclose(view.camera.rays(), CAMERA.rays()[::4, ::4])


def test_only_settings_that_no_other_beats_are_joined() -> None:
    def point(cpu_ms: float, right: float) -> Point:
        return Point("a", 0.1, cpu_ms, right, 0.0, False, False)

    points = [point(30, 0.7), point(10, 0.5), point(20, 0.4), point(40, 0.7), point(50, 0.9)]
    assert [p.cpu_ms for p in frontier(points, "right")] == [10, 30, 50]


def _peers() -> Sequence[tuple[str, Callable[[Scene], Peer]]]:
    full = Knob("full")
    return [
        ("mrf", lambda scene: our_maps.MrfPeer(scene, VOXEL_M, full)),
        ("log-odds", lambda scene: our_maps.log_odds(scene, VOXEL_M, full)),
        ("bonxai", lambda scene: our_maps.log_odds(scene, VOXEL_M, Knob("", 1, our_maps.BONXAI))),
        ("visibility", lambda scene: our_maps.visibility(scene, VOXEL_M, full)),
        ("wavemap", lambda scene: our_maps.wavemap(scene, VOXEL_M, Knob("", 1))),
        ("octomap", lambda scene: OctomapPeer(scene, VOXEL_M, full)),
        ("open3d", lambda scene: TsdfPeer(scene, VOXEL_M, Knob("", 1, {"truncation": 4.0}))),
    ]


@pytest.mark.parametrize("name", [name for name, _ in _peers()])
def test_each_peer_finds_the_wall(name: str) -> None:
    if name == "octomap" and not octomap_available():
        pytest.skip("pyoctomap (the extra bench) is not installed")
    if name == "open3d":
        pytest.importorskip("open3d", reason="open3d (the extra bench) is not installed")
    scene = wall()
    peer = mapped(dict(_peers())[name](scene), scene)
    best = max(
        answer_scores(answers, scene.views[3], wall_case(scene))[RIGHT]
        for answers in peer.answers(scene.views[3]).values()
    )
    assert best > (0.8 if name == "open3d" else 0.95)  # a mesh ends at the outermost voxels that are seen
    in_front, at_the_wall, far_behind = [0.02, 0.02, 1.0], [0.02, 0.02, WALL_M], [0.02, 0.02, 3.9]
    cells = next(iter(peer.cells(np.array([in_front, at_the_wall, far_behind])).values()))
    assert cells.free.tolist() == [True, False, False]
    assert cells.occupied.tolist() == [False, True, False]
    assert cells.probability[1] > cells.probability[0]
    assert peer.memory_mb > 0


@needs_octomap
def test_octomap_answers_as_the_log_odds_map_does() -> None:
    scene = wall()
    tree = mapped(OctomapPeer(scene, VOXEL_M, Knob("")), scene)
    ours = mapped(our_maps.log_odds(scene, VOXEL_M, Knob("")), scene)
    points = along_rays(scene, [3], VOXEL_M).points_m
    theirs, own = (peer.cells(points)[""].probability for peer in (tree, ours))
    assert np.mean(np.abs(theirs - own) < 0.01) > 0.98  # rays through edges of voxels may go either way


def test_keyframes_cost_less_a_frame() -> None:
    scene = wall()
    system = System("", our_maps.log_odds, [])
    all_frames, kept = (
        measured(system, knob, wall_case(scene)) for knob in (Knob("all"), Knob("all").of_keyframes())
    )
    assert (all_frames["keyframes"], kept["keyframes"]) == (3, 1)  # the camera hardly moves
    assert kept["frames"] == all_frames["frames"] == 3
    assert kept["cpu_ms"] == pytest.approx(kept["cpu_ms_keyframe"] / 3)


def test_settings_have_names_of_their_own_and_one_standard() -> None:
    for lidar in (False, True):
        for system in systems(lidar):
            names = [knob.name for knob in system.knobs]
            assert len(set(names)) == len(names)
            assert sum(knob.standard for knob in system.knobs) == 1
            assert not (lidar and system.images_only)


def test_the_comparison_goes_on_where_it_was(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = [
        System("MRFMap", our_maps.MrfPeer, [Knob("coarse", 2), Knob("all", standard=True)]),
        System("log-odds", our_maps.log_odds, [Knob("all", standard=True)]),
    ]
    monkeypatch.setattr(run, "systems", lambda lidar: few)
    monkeypatch.setattr(cases, "FIRST", 1)
    done: list[str] = []

    def evaluate() -> tuple[list, list[Path]]:
        parts = ("kitchen, 10 cm, *", "house*")
        return run_experiment(
            "peers",
            EXPERIMENTS["peers"],
            data,
            tmp_path,
            (0.1,),
            (0,),
            None,
            lambda what, *_: done.append(what),
            parts,
        )

    (budgets, settings, states, profile), paths = evaluate()
    assert [row[:4] for row in settings.rows] == [
        [scene, "10 cm", system, knob]
        for scene in ("kitchen", "house")
        for system, knob in (("MRFMap", "coarse"), ("MRFMap", "all"), ("log-odds", "all"))
    ]
    assert all(path.is_file() for path in paths)
    assert {"peers_kitchen.png", "peers_house.png"} <= {path.name for path in paths}
    assert [row[:3] for row in budgets.rows] == [
        [scene, "10 cm", system] for scene in ("kitchen", "house") for system in ("MRFMap", "log-odds")
    ]
    rows = [dict(zip(settings.columns, row, strict=True)) for row in settings.rows]
    assert all(row["ms a frame"] > 0 and row[RIGHT] > 0.3 for row in rows)
    by_map = {(row[0], row[2]): dict(zip(states.columns, row, strict=True)) for row in states.rows}
    assert by_map["house", "MRFMap, marginal"]["F 5 cm"] > 0.3
    assert by_map["kitchen", "log-odds"]["F 5 cm"] is None  # there is no truth
    assert [row[3] for row in profile.rows] == ["coarse", "all"] * 2
    monkeypatch.setattr(run, "measured", lambda *_: pytest.fail("a known result is computed again"))
    (_, again, *_), _ = evaluate()
    assert again.rows == settings.rows


def test_a_pinhole_of_one_row_is_no_lidar() -> None:
    """Beams of a lidar are thinned by the square: its camera has one row."""
    scene = wall()
    assert scene.camera.height > 1
    row = PinholeCamera(80, 1, 60.0, 60.0, 39.5, 0.0)
    view = SceneView("", np.eye(4), *(np.ones((1, 80), np.float32),) * 2, np.ones((1, 80), bool), camera=row)
    assert thinned(view, scene, 2).measured_m.shape == (1, 20)
