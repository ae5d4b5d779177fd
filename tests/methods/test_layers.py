"""Maps of a world that changes, read by layers and as of other times, and what has changed."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import small_room
from ball_room import EVERYWHERE, SEEING, TIME, camera, near_ball, room_that_changed, views
from console import carry_out

from taichi_mrf.cli.info import map_facts
from taichi_mrf.config.arguments import ArgumentTypeError
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.export.formats import FORMATS, export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.reading import LAYERS, MapReading
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.system import runtime

pytestmark = pytest.mark.usefixtures("one_backend")

BEFORE_S = 19.0
"""The stamp of the last view before the change."""


@pytest.fixture(scope="module")
def saved(one_backend: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "map.npz"
    room_that_changed(ball_comes=True).save(path)
    return path


def export(*arguments: object) -> int:
    return carry_out("export", *arguments, "--arch", runtime.active() or "cpu")


def test_a_layer_is_one_call() -> None:
    m = room_that_changed(ball_comes=True)
    probes = small_room.probes()
    static, dynamic, both = (m.layer(which) for which in LAYERS)
    for named, read in ((m.static, static), (m.dynamic, dynamic), (m, both)):
        np.testing.assert_array_equal(named.marginals.occupancy(probes), read.marginals.occupancy(probes))
    occupied = {which: m.layer(which).state(probes) == OCCUPIED for which in LAYERS}
    assert not (occupied["static"] & occupied["dynamic"]).any()
    assert (occupied["static"] | occupied["dynamic"])[occupied["both"]].all()
    assert occupied["dynamic"].sum() > 20
    assert near_ball(dynamic.voxels()[0]).mean() > 0.5
    # Free space is the static layer's, also where the map keeps no voxels.
    assert (static.state(probes) == FREE).sum() > 10000
    assert not (dynamic.state(probes) == FREE).any()
    assert not near_ball(m.layer("dynamic", BEFORE_S).voxels()[0]).any()


def test_poses_that_are_off_move_nothing() -> None:
    """Of a static room, seen from poses 3 cm off, over 1% of the voxels are occupied against the sum of all
    evidence; they lie beside its surfaces."""
    m, rng = MRFMap(small_room.VOXEL_SIZE, time=TIME), np.random.default_rng(0)
    for depth_m, pose in views(EVERYWHERE * 2, ball=False):
        T_world_camera = pose.copy()
        T_world_camera[:3, 3] += rng.normal(0.0, 0.03, 3)
        m.add_keyframe(depth_m, T_world_camera, camera())
    m.infer()
    assert len(m.dynamic.voxels()[0]) < 0.001 * len(m.voxels()[0])


def test_layers_that_there_are_not() -> None:
    m = room_that_changed(ball_comes=True)
    with pytest.raises(ConfigError, match="no layer 'moving'; choose from static, dynamic, both"):
        m.layer("moving")  # type: ignore[arg-type]
    with pytest.raises(ArgumentTypeError, match="stamp_s must be a number"):
        m.at("now")  # type: ignore[arg-type]
    static = small_room.build([0])
    for ask in (lambda: static.layer("dynamic"), lambda: static.changes(0.0)):
        with pytest.raises(ConfigError, match=r"set time\.half_life_s"):
            ask()
    np.testing.assert_array_equal(static.layer("both").voxels()[0], static.marginals.voxels()[0])


def test_every_format_of_a_layer(tmp_path: Path) -> None:
    m, options = room_that_changed(ball_comes=True), ExportOptions(z_min=-2.0, z_max=2.0)
    layer = m.dynamic
    for extension in FORMATS:
        assert export_map(layer, tmp_path / f"map{extension}", options)
    for extension in (".html", ".ot"):
        assert export_map(m.static, tmp_path / f"static{extension}", options)  # has cells of several voxels
    with np.load(tmp_path / "map.npz") as file:
        centres = (file["voxels"] + 0.5) * float(file["voxel_size"])
        np.testing.assert_array_equal(file["state"], layer.state(centres))
        assert len(file["free_bricks"]) == 0


def test_a_layer_from_the_command_line(saved: Path, tmp_path: Path) -> None:
    m = room_that_changed(ball_comes=True)
    wanted: dict[str, tuple[list[object], MapReading]] = {
        "before": (["--at", BEFORE_S], m.at(BEFORE_S)),
        "relative": (["--layer", "static", "--at", -4], m.layer("static", m.now_s - 4)),
    }
    for name, (flags, reading) in wanted.items():
        assert export(saved, "--to", tmp_path / f"{name}.npz", *flags) == 0
        with np.load(tmp_path / f"{name}.npz") as file:
            centres = (file["voxels"] + 0.5) * float(file["voxel_size"])
            np.testing.assert_allclose(file["probability"], reading.occupancy(centres), atol=1e-3)


def test_maps_that_have_no_layers(saved: Path, tmp_path: Path) -> None:
    small_room.build([0]).save(tmp_path / "static.npz")
    LogOddsMap(0.1, time=TIME).save(tmp_path / "log_odds.npz")
    for path, flags, problem in (
        (tmp_path / "static.npz", ["--layer", "dynamic"], "mapped with --time.half-life-s"),
        (tmp_path / "log_odds.npz", ["--at", "3"], "need a map of mrf; .* is one of log_odds"),
        (tmp_path / "map.zarr", ["--layer", "static"], "has no keyframes"),
        (saved, ["--at", "-1000"], "no keyframe at that time; they are from 0 to 23 s"),
    ):
        with pytest.raises(ConfigError, match=problem):
            export(path, "--to", tmp_path / "out.ply", *flags)
    assert not (tmp_path / "out.ply").exists()


def test_info_shows_the_time_of_a_map(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = map_facts(str(saved))
    assert (facts["stamps_s"], facts["half_life_s"]) == ([0.0, 23.0], 600.0)
    assert carry_out("info", saved) == 0
    shown = capsys.readouterr().out
    assert "23.0 s, stamps 0 to 23" in shown
    assert "half-life 600 s" in shown
    assert carry_out("info", saved, "--json") == 0
    assert json.loads(capsys.readouterr().out)["stamps_s"] == [0.0, 23.0]


def test_what_appeared() -> None:
    m = room_that_changed(ball_comes=True)
    change = m.changes(BEFORE_S)
    assert near_ball(change.appeared).sum() > 20
    assert near_ball(change.appeared).mean() > 0.5
    assert not near_ball(change.vanished).any()
    appeared = (change.before == FREE) & (change.after == OCCUPIED)
    np.testing.assert_array_equal(change.points[appeared], change.appeared)
    assert (m.at(BEFORE_S).state(change.appeared) == FREE).all()
    assert (m.state(change.appeared) == OCCUPIED).all()
    assert not len(m.changes(m.now_s).appeared)


def test_what_vanished() -> None:
    change = room_that_changed(ball_comes=False).changes(BEFORE_S)
    assert near_ball(change.vanished).sum() > 20
    assert near_ball(change.vanished).mean() > 0.5
    assert not near_ball(change.appeared).any()


@pytest.mark.parametrize("ball_comes", [True, False])
def test_rays_tell_what_is_new_from_what_is_gone(ball_comes: bool) -> None:
    """One view against the map of all views before the change."""
    earlier = room_that_changed(ball_comes).at(BEFORE_S)
    old, new = (views(SEEING[:2], ball=ball) for ball in (not ball_comes, ball_comes))
    for (was_m, _), (depth_m, T_world_camera) in zip(old, new, strict=True):
        scores = earlier.ray_scores(depth_m, T_world_camera, camera())
        changed = (was_m != depth_m) & (depth_m > 0)
        against = scores > 3 if ball_comes else scores < -3
        assert against[changed].mean() > 0.8  # the others graze the ball
        assert (np.abs(scores[~changed & (depth_m > 0)]) > 3).mean() < 0.1
        assert np.isnan(scores[depth_m == 0]).all()


def test_scores_of_rays_without_an_answer() -> None:
    m = room_that_changed(ball_comes=True)
    depth_m, T_world_camera = views([0], ball=False)[0]
    nothing = np.where(np.arange(depth_m.size).reshape(depth_m.shape) % 2, np.nan, -1.0)
    assert np.isnan(m.ray_scores(nothing, T_world_camera, camera())).all()
    assert np.isnan(m.ray_scores(np.full(depth_m.shape, 99.0), T_world_camera, camera())).all()
    elsewhere = T_world_camera.copy()
    elsewhere[:3, 3] += 500.0
    assert (m.ray_scores(np.full(depth_m.shape, 2.0), elsewhere, camera()) == 0).all()
    with pytest.raises(ConfigError, match=re.escape("shape (90, 120), not (2, 2)")):
        m.ray_scores(np.ones((2, 2)), T_world_camera, camera())
    with pytest.raises(KeyframeError):
        m.ray_scores(depth_m, np.zeros((4, 4)), camera())


def test_a_ray_into_surely_free_space_is_as_unlikely_as_an_outlier() -> None:
    """The bound of a score, from its formula."""
    m = room_that_changed(ball_comes=True)
    depth_m, T_world_camera = views([0], ball=False)[0]
    near = np.full(depth_m.shape, 1.0)
    scores = m.static.ray_scores(near, T_world_camera, camera())
    free = m.static.state(T_world_camera[None, :3, 3] + T_world_camera[None, :3, 2]) == FREE
    assert free.all()
    sigma = m.noise.table(camera()).at_pixels(near)[0]
    spread = np.sqrt(2 * np.pi * (sigma**2 + m.voxel_size**2 / 12))
    best = np.minimum(1 / spread, 1 / m.voxel_size)
    most = np.log(1 + 0.99 * best * m.sensor.max_depth / 0.01)
    middle = scores.shape[0] // 2, scores.shape[1] // 2
    assert scores[middle] == pytest.approx(most[middle], abs=0.3)
    assert (scores <= most + 1e-3).all()


def test_a_map_of_log_odds_has_scores_too() -> None:
    m = LogOddsMap(small_room.VOXEL_SIZE)
    for depth_m, T_world_camera in views(SEEING, ball=False):
        m.add_keyframe(depth_m, T_world_camera, camera())
    was_m, T_world_camera = views([0], ball=False)[0]
    depth_m = views([0], ball=True)[0][0]
    scores = m.ray_scores(depth_m, T_world_camera, camera())
    assert (scores[(was_m != depth_m) & (depth_m > 0)] > 3).mean() > 0.85


def test_unknown_space_is_no_contradiction() -> None:
    frame = small_room.frames()[0]
    m = MRFMap(small_room.VOXEL_SIZE, time=TIME)
    m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, stamp_s=0.0)
    m.infer()
    other = small_room.frames()[5]
    points = other.camera.rays() * other.depth_m[..., None].astype(np.float64)
    points = points @ other.T_world_camera[:3, :3].T + other.T_world_camera[:3, 3]
    unknown = (m.state(points.reshape(-1, 3)) == UNKNOWN).reshape(other.depth_m.shape) & (other.depth_m > 0)
    scores = m.ray_scores(other.depth_m, other.T_world_camera, other.camera)
    assert unknown.mean() > 0.2
    assert (scores[unknown] <= 0).all()


def test_rays_have_no_votes_for_what_is_gone() -> None:
    m = room_that_changed(ball_comes=False)
    reading = m.decided
    centres = reading.marginals.voxels()[0]
    assert len(centres) > len(m.marginals.voxels()[0])
    assert near_ball(m.at(BEFORE_S).voxels()[0]).any()
    assert not near_ball(centres).any()
