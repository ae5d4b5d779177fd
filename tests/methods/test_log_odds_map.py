"""LogOddsMap: its counts against plain geometry, its updates against plain arithmetic, and the whole of it
against OctoMap itself."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracles.traversal import segments

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.config.sections import LogOddsConfig, TimeConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.inference.keyframe import DepthImage, checked_depth
from taichi_mrf.methods.log_odds.map import LogOddsMap, ScanIntegrator, count_rays, weigh
from taichi_mrf.methods.recursive_update import log_odds
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick

# Written out, and not imported: these tests hold the values.
LEAST_LOG_ODDS = 1e-06

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

CAMERA = PinholeCamera(width=26, height=19, fx=22, fy=23, cx=12.3, cy=9.4)
VOXEL = 0.05
MAX_DEPTH = 3.5
NOISE = PolynomialNoise((0.01,))

GRAZING = 2e-3
"""In voxels: a ray that is nearer than this to a voxel's edge may or may not count."""

POSES = {
    "oblique": look_at((0.317, -0.213, 0.104), (2.0, 1.5, -0.4)),
    "negative": look_at((-7.113, -3.322, -2.231), (-9.0, -2.0, -3.0)),
    "far away": look_at((140.03, -260.02, 31.013), (139.0, -263.0, 30.5)),
}

OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "max_range": {"max_range": 2.0},
    "discretise": {"discretise": True},
    "both": {"discretise": True, "max_range": 2.0},
}

Voxel = tuple[int, ...]


def rough_wall(seed: int = 0) -> NDArray[np.float32]:
    """Depths of a rough surface with holes, from 0.4 m to beyond the sensor's range."""
    random = np.random.default_rng(seed)
    v, u = np.indices(CAMERA.shape)
    depth = 2.2 + np.sin(u / 5 + seed) + 0.6 * np.cos(v / 3) + 0.1 * random.normal(size=CAMERA.shape)
    depth[random.random(CAMERA.shape) < 0.2] = 0
    return depth.astype(np.float32)


def near_a_face(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """True if float32 may put a point into another voxel."""
    voxels = points_m / VOXEL
    return (np.abs(voxels - np.round(voxels)) < GRAZING).any(axis=-1)


def expected_ends(
    depth_m: NDArray[np.float32], T: Pose, *, max_range: float = 0.0, discretise: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(n, 3) ends in metres and whether each is a hit, as OctoMap has it, from the depths that there are."""
    z = depth_m[depth_m > 0].astype(np.float64)
    points = CAMERA.rays()[depth_m > 0] * np.minimum(z, MAX_DEPTH)[:, None] @ T[:3, :3].T + T[:3, 3]
    hits = z <= MAX_DEPTH
    if discretise:
        once = {(*np.floor(p / VOXEL), hit): hit for p, hit in zip(points, hits, strict=True)}
        points = (np.array([key[:3] for key in once]) + 0.5) * VOXEL
        hits = np.array(list(once.values()))
    ranges = np.linalg.norm(points - T[:3, 3], axis=1)
    if max_range > 0:
        far = ranges > max_range
        points[far] = T[:3, 3] + (points[far] - T[:3, 3]) * max_range / ranges[far, None]
        hits &= ~far
    return points, hits


def without_doubtful(depth_m: NDArray[np.float32], T: Pose, max_range: float = 0.0) -> NDArray[np.float32]:
    """The image without the pixels of which rounding may decide where their rays end."""
    depth = depth_m.copy()
    for cut in (0.0, max_range):
        points, _ = expected_ends(depth, T, max_range=cut)
        depth[tuple(np.argwhere(depth > 0)[near_a_face(points)].T)] = 0
    return depth


def expected_counts(
    points_m: NDArray[np.float64], hits: NDArray[np.bool_], T: Pose
) -> tuple[Counter[Voxel], Counter[Voxel], Counter[Voxel]]:
    """Hits of each voxel, and the least and the most misses that it may have."""
    neighbours = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    hit_counts, least, most = Counter[Voxel](), Counter[Voxel](), Counter[Voxel]()
    origin = T[:3, 3] / VOXEL
    for point, hit in zip(points_m / VOXEL, hits, strict=True):
        last = tuple(np.floor(point).astype(int).tolist())
        if hit:
            hit_counts[last] += 1
        cells, _, _ = segments(origin, point - origin, 0.0, 1.0)
        cells = np.unique((cells[:, None] + neighbours).reshape(-1, 3), axis=0)
        for counts, shrink in ((least, GRAZING), (most, -GRAZING)):
            low, high = ((cells + at - origin) / (point - origin) for at in (shrink, 1 - shrink))
            enter = np.minimum(low, high).max(axis=1).clip(0.0)
            leave = np.maximum(low, high).min(axis=1).clip(None, 1.0)
            passed = {tuple(cell) for cell in cells[enter < leave].tolist()} - {last}
            counts.update(passed)
    return hit_counts, least, most


def counted(
    depth_m: NDArray[np.float32], T: Pose, *, every_ray: bool = True, **options: Any
) -> tuple[Counter[Voxel], Counter[Voxel]]:
    """Hits and misses of each voxel as the kernels count them."""
    integrator = ScanIntegrator(VOXEL, MAX_DEPTH, LogOddsConfig(**options), VolumeConfig())
    image = DepthImage.upload(checked_depth(depth_m, CAMERA, 0.1), CAMERA, NOISE)
    footprint = integrator.reach(image, T)
    window, cells = footprint.window, footprint.crossed
    integrator.index.fill(window, cells, np.arange(len(cells), dtype=np.int32))
    count_rays(
        footprint.ends, footprint.starts, integrator.index.space(window), integrator.tally,
        every_ray,
    )  # fmt: skip
    tally = integrator.tally.to_numpy()
    assert (tally[len(cells) * VOXELS :] == 0).all()
    at = np.flatnonzero(tally)
    voxels = window.bricks_of(cells)[at // VOXELS] * BRICK + offsets_in_brick()[at % VOXELS]
    hits, misses = Counter[Voxel](), Counter[Voxel]()
    for voxel, packed in zip(voxels.tolist(), tally[at].tolist(), strict=True):
        hits[tuple(voxel)], misses[tuple(voxel)] = packed >> 32, packed & 0xFFFFFFFF
    return +hits, +misses


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("pose", POSES)
def test_rays_are_counted_as_geometry_has_it(pose: str, options: dict[str, Any]) -> None:
    T = POSES[pose]
    depth = without_doubtful(rough_wall(), T, options.get("max_range", 0.0))
    assert (depth > 0).sum() > 300
    points, hit = expected_ends(depth, T, **options)
    expected_hits, least, most = expected_counts(points, hit, T)
    hits, misses = counted(depth, T, **options)
    assert hits == expected_hits
    assert least <= misses <= most
    assert sum(misses.values()) > 20 * len(points)
    assert sum(most.values()) - sum(least.values()) < 0.05 * sum(misses.values())


def test_without_every_ray_only_their_presence_is_counted() -> None:
    T = POSES["oblique"]
    hits, misses = counted(rough_wall(), T)
    some_hits, some_misses = counted(rough_wall(), T, every_ray=False)
    assert max(hits.values()) > 1
    assert some_hits == Counter(hits.keys())
    assert some_misses == Counter(misses.keys())


scans = st.lists(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 400_000)), min_size=16, max_size=16),
    min_size=1,
    max_size=8,
)


@pytest.mark.parametrize("every_ray", [False, True])
@given(scans=scans, hit=st.floats(0.51, 0.99), miss=st.floats(0.01, 0.49))
def test_updates_are_weighed_scan_by_scan(
    every_ray: bool, scans: list[list[tuple[int, int]]], hit: float, miss: float
) -> None:
    """Also in this order: between two scans the log-odds are clamped."""
    lowest, highest = log_odds(0.1192), log_odds(0.971)
    belief, tally = ti.ndarray(ti.f32, VOXELS), ti.ndarray(ti.i64, VOXELS)
    belief.fill(0.0)
    expected = np.zeros(16)
    for scan in scans:
        hits, misses = np.array(scan).T
        packed = np.zeros(VOXELS, np.int64)
        packed[:16] = (hits << 32) + misses
        tally.from_numpy(packed)
        weigh(np.zeros(1, np.int32), belief, tally, log_odds(hit), log_odds(miss), lowest, highest, every_ray)
        change = hits * log_odds(hit) + misses * log_odds(miss)
        if not every_ray:
            change = np.where(hits > 0, log_odds(hit), log_odds(miss))
        expected = np.where(hits + misses > 0, np.clip(expected + change, lowest, highest), expected)
        assert (tally.to_numpy() == 0).all()
    found = belief.to_numpy()
    # The sum of some 10^5 rays has six digits in float32; clamped, what is lost is lost.
    scale = np.abs(np.array(scans)).max() * max(log_odds(hit), -log_odds(miss)) if every_ray else 5.0
    np.testing.assert_allclose(found[:16], expected, atol=max(1e-5, 3e-7 * scale))
    assert (found[16:] == 0).all()


def test_a_voxel_that_was_seen_is_never_unknown_again() -> None:
    """A hit and a miss of one weight add up to 0, which stands for the unknown."""
    belief, tally = ti.ndarray(ti.f32, VOXELS), ti.ndarray(ti.i64, VOXELS)
    belief.fill(0.0)
    for packed in (1 << 32, 1):
        tally.fill(0)
        counts = np.zeros(VOXELS, np.int64)
        counts[0] = packed
        tally.from_numpy(counts)
        weigh(np.zeros(1, np.int32), belief, tally, 0.4, -0.4, -2.0, 3.5, False)
    assert belief.to_numpy()[0] == np.float32(LEAST_LOG_ODDS)


ROW = PinholeCamera(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
"""One pixel that looks along the z axis."""


def row_states(m: LogOddsMap, z_m: list[float]) -> list[int]:
    return m.state([[0.05, 0.05, z] for z in z_m]).tolist()


def one_pixel(depth_m: float, **parameters: Any) -> LogOddsMap:
    """Voxels of 10 cm; the camera stands in the middle of one and looks along a row of them."""
    m = LogOddsMap(0.1, PolynomialNoise((0.01,), (0.06,)), **parameters)
    T = np.eye(4)
    T[:3, 3] = 0.05
    m.add_keyframe(np.full((1, 1), depth_m, np.float32), T, ROW)
    return m


def test_a_row_of_voxels() -> None:
    m = one_pixel(1.02)  # from 0.05 to 1.07
    assert row_states(m, [-0.05, 0.05, 0.95, 1.05, 1.15]) == [UNKNOWN, FREE, FREE, OCCUPIED, UNKNOWN]
    p = m.occupancy([[0.05, 0.05, z] for z in (0.05, 1.05, 1.15)])
    np.testing.assert_allclose(p, [0.4, 0.7, 0.5], atol=1e-6)


def test_what_is_cut_off_ends_in_a_voxel_that_stays_unknown() -> None:
    """OctoMap's rays never include the voxel that they end in, also where nothing was hit."""
    for m in (one_pixel(2.0, max_range=1.02), one_pixel(2.0, max_depth=1.02)):
        assert row_states(m, [0.05, 0.95, 1.05, 1.95, 2.05]) == [FREE, FREE, UNKNOWN, UNKNOWN, UNKNOWN]


def test_the_mapped_volume_bounds_what_is_said() -> None:
    volume = VolumeConfig(lower=(-1.0, -1.0, 0.3), upper=(1.0, 1.0, 0.8))
    m = one_pixel(1.02, volume=volume)
    assert row_states(m, [0.25, 0.35, 0.75, 0.85, 1.05]) == [UNKNOWN, FREE, FREE, UNKNOWN, UNKNOWN]
    for discretise in (False, True):
        m = one_pixel(0.72, volume=volume, discretise=discretise)
        assert row_states(m, [0.25, 0.35, 0.65, 0.75]) == [UNKNOWN, FREE, FREE, OCCUPIED]
    outside = VolumeConfig(lower=(5.0, 5.0, 5.0), upper=(6.0, 6.0, 6.0))
    assert one_pixel(1.02, volume=outside).statistics().bricks == 0


def test_the_bias_is_taken_out_when_asked_for() -> None:
    assert row_states(one_pixel(1.02, correct_bias=True), [0.95, 1.05]) == [FREE, OCCUPIED]
    assert row_states(one_pixel(1.00, correct_bias=False), [0.95, 1.05]) == [FREE, OCCUPIED]
    assert row_states(one_pixel(1.00, correct_bias=True), [0.85, 0.95, 1.05]) == [FREE, OCCUPIED, UNKNOWN]


def test_a_hit_wins_within_a_scan_but_not_ray_by_ray() -> None:
    """Hundreds of rays pass a voxel at the camera's side in which one of them ends."""
    camera = PinholeCamera(width=40, height=1, fx=400.0, fy=400.0, cx=19.5, cy=0.0)
    depth = np.full(camera.shape, 2.0, np.float32)
    depth[0, 20] = 0.5
    T = np.eye(4)
    T[:3, 3] = 0.05
    maps = [LogOddsMap(0.1, update=update) for update in ("scan", "ray")]
    for m in maps:
        m.add_keyframe(depth, T, camera)
    place = [[0.05, 0.05, 0.55]]
    assert [m.state(place)[0] for m in maps] == [OCCUPIED, FREE]


def test_an_impossible_parameter_is_named() -> None:
    with pytest.raises(ConfigError, match="LogOddsMap: unknown parameter 'hits'; did you mean 'hit'"):
        LogOddsMap(hits=0.7)
    with pytest.raises(ConfigError, match=r"log_odds\.miss"):
        LogOddsMap(miss=0.6)


def test_a_scan_that_does_not_fit_changes_nothing() -> None:
    m = LogOddsMap(0.05, volume=VolumeConfig(memory_limit_gb=0.0006))
    m.add_keyframe(np.where(np.indices(CAMERA.shape)[0] == 9, 0.5, 0.0).astype(np.float32), np.eye(4), CAMERA)
    before, size = m.voxels(0.0), m.statistics()
    with pytest.raises(CapacityError, match="larger voxels"):
        m.add_keyframe(np.full(CAMERA.shape, 3.0, np.float32), np.eye(4), CAMERA)
    assert m.statistics() == size
    np.testing.assert_array_equal(m.voxels(0.0)[0], before[0])


def test_a_scan_for_which_there_are_no_bricks_lets_no_time_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    m = LogOddsMap(0.05, time=TimeConfig(half_life_s=1.0))
    m.add_keyframe(np.full(CAMERA.shape, 1.0, np.float32), np.eye(4), CAMERA)
    before = m.voxels(0.0)

    def refuse(*_: object) -> None:
        raise CapacityError("no room")

    monkeypatch.setattr(m._registry, "claim", refuse)
    with pytest.raises(CapacityError, match="no room"):
        m.add_keyframe(np.full(CAMERA.shape, 3.0, np.float32), np.eye(4), CAMERA, stamp_s=3.0)
    for now, then in zip(m.voxels(0.0), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_with_a_half_life_the_order_in_which_scans_come_does_not_matter() -> None:
    """A box that was there first and is gone later is gone, whichever scan comes late."""
    near, far = (np.full(CAMERA.shape, depth_m, np.float32) for depth_m in (1.02, 2.02))
    scans = [(near, 0.0), (near, 1.0), (far, 20.0), (far, 21.0)]
    found = []
    for order in ((0, 1, 2, 3), (2, 3, 0, 1), (3, 0, 2, 1)):
        m = LogOddsMap(0.05, time=TimeConfig(half_life_s=5.0))
        for i in order:
            m.add_keyframe(scans[i][0], np.eye(4), CAMERA, f"{i}", scans[i][1])
        assert m.stale == (order != (0, 1, 2, 3))
        m.infer()
        assert not m.stale
        found.append(m.voxels(0.0))
    middle = CAMERA.rays()[CAMERA.height // 2, CAMERA.width // 2]
    assert m.state(np.outer((1.02, 2.02), middle)).tolist() == [FREE, OCCUPIED]
    for other in found[1:]:
        for now, then in zip(other, found[0], strict=True):
            np.testing.assert_array_equal(now, then)
    static = LogOddsMap(0.05)
    for i in (2, 3, 0, 1):
        static.add_keyframe(scans[i][0], np.eye(4), CAMERA, f"{i}", scans[i][1])
    assert not static.stale


def octomap_voxels(
    frames: list[Frame], voxel_size: float, *, max_range: float = 0.0, discretise: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """OctoMap's own map of some frames: its known voxels (n, 3) and their log-odds (n,)."""
    pyoctomap = pytest.importorskip("pyoctomap", reason="OctoMap itself is not here: pip install pyoctomap")
    tree = pyoctomap.OcTree(voxel_size)
    for frame in frames:
        measured = np.isfinite(frame.depth_m) & (frame.depth_m >= 0.1)
        points = frame.camera.rays()[measured] * frame.depth_m[measured, None].astype(np.float64)
        T = frame.T_world_camera
        world = np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3])
        tree.insertPointCloud(world, T[:3, 3].copy(), max_range or -1.0, False, discretise)
    leaves = [
        (*leaf.getCoordinate(), leaf.getSize(), leaf.current_node.getLogOdds()) for leaf in tree.begin_leafs()
    ]
    table = np.array(leaves)
    sides = np.rint(table[:, 3] / voxel_size).astype(int)
    voxels, values = [], []
    for side in np.unique(sides):  # a pruned leaf stands for side^3 voxels
        chosen = table[sides == side]
        lowest = np.rint(chosen[:, :3] / voxel_size - side / 2).astype(np.int64)
        inside = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        voxels.append((lowest[:, None] + inside).reshape(-1, 3))
        values.append(np.repeat(chosen[:, 4], side**3))
    return np.concatenate(voxels), np.concatenate(values)


def share_of_equal_states(m: LogOddsMap, voxels: NDArray[np.int64], values: NDArray[np.float64]) -> float:
    """Share of the voxels known to either map that both call free, or both occupied."""
    centres, _ = m.voxels(0.0)
    mine = {tuple(v) for v in np.floor(centres / m.voxel_size).astype(int).tolist()}
    theirs = {tuple(v) for v in voxels.tolist()}
    states = m.state((voxels + 0.5) * m.voxel_size)
    return int((states == np.where(values >= 0, OCCUPIED, FREE)).sum()) / len(mine | theirs)


def mapped(frames: list[Frame], voxel_size: float, **options: Any) -> LogOddsMap:
    m = LogOddsMap(voxel_size, max_depth=20.0, **options)
    for frame in frames:
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    return m


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_the_room_is_what_octomap_makes_of_it(options: dict[str, Any]) -> None:
    dataset = open_dataset("synthetic:room?width=160&height=120&frames=10")
    frames = [dataset.read(i) for i in range(5)]
    m = mapped(frames, 0.1, **options)
    assert share_of_equal_states(m, *octomap_voxels(frames, 0.1, **options)) >= 0.999
    # The comparison can tell one map from another.
    other = {**options, "discretise": not options.get("discretise", False)}
    assert share_of_equal_states(m, *octomap_voxels(frames, 0.1, **other)) < 0.999


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("voxel_size", "options"),
    [(0.05, OPTIONS["plain"]), (0.02, OPTIONS["both"])],
    ids=["plain", "both, fine"],
)
def test_the_kitchen_is_what_octomap_makes_of_it(
    shared_data: Path, voxel_size: float, options: dict[str, Any]
) -> None:
    dataset = open_dataset(shared_data / "seven_scenes_redkitchen")
    frames = [dataset.read(i) for i in ((0, 20, 40, 60) if voxel_size == 0.05 else (0, 40))]
    voxels, values = octomap_voxels(frames, voxel_size, **options)
    m = mapped(frames, voxel_size, **options)
    assert share_of_equal_states(m, voxels, values) >= 0.999
    p = m.occupancy((voxels + 0.5) * voxel_size)
    assert (np.abs(p - 1 / (1 + np.exp(-values))) < 1e-5).mean() >= 0.999
