"""A recording that goes on in an earlier map: the same map as of one run, later dates, other names."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inputs_frames import Frames
from small_room import assert_same_voxels
from two_days import CONFIG, COUNT, STOOL, TODAY, YESTERDAY, recorded, turned_away

import taichi_mrf as tm
from taichi_mrf.alignment.locate_recording import LocatedRecording
from taichi_mrf.config.schema import Config, KeyframeConfig, PoseConfig, TimeConfig
from taichi_mrf.datasets.base import EndlessNames
from taichi_mrf.datasets.synthetic.room_furniture import ROOM_IN_WORLD
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import inverse, tangent_norms
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.onto import Placed, freeze_all, locate, parameters_onto, placed_in
from taichi_mrf.mapping.pipeline import FrameOffered, map_sequence
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples
from taichi_mrf.session.report import run_report

pytestmark = pytest.mark.usefixtures("one_backend")


@pytest.fixture(scope="module")
def saved(one_backend: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of yesterday."""
    path = tmp_path_factory.mktemp("yesterday") / "map.npz"
    map_sequence(recorded(YESTERDAY), CONFIG).map.save(path)
    return path


def where_it_is(dataset: Frames, m: MRFMap) -> Placed:
    """A dataset of the map's own world."""
    located = LocatedRecording(np.eye(4))
    origin_m = np.zeros(3)
    return Placed(
        "today",
        dataset.camera,
        source=dataset,
        located=located,
        prefix="",
        later_s=0.0,
        map_origin_m=origin_m,
    )


def assert_same_map(a: MRFMap, b: MRFMap) -> None:
    assert_same_voxels(a.marginals, b.marginals)
    centres, _ = a.marginals.voxels(min_probability=0.0)
    np.testing.assert_array_equal(a.state(centres), b.state(centres))


def test_todays_keyframes_join_as_if_there_had_been_one_run(saved: Path) -> None:
    m = tm.load_map(saved)
    joined = map_sequence(where_it_is(recorded(TODAY), m), CONFIG, onto=m)
    at_once = map_sequence(recorded(sorted([*YESTERDAY, *TODAY])), CONFIG)
    assert joined.before == len(YESTERDAY)
    assert len(joined.map.keyframes) == len(YESTERDAY) + len(TODAY)
    assert_same_map(joined.map, at_once.map)


def test_a_run_that_was_stopped_goes_on_in_the_same_map(saved: Path) -> None:
    first = tm.load_map(saved)
    today = where_it_is(recorded(TODAY), first)
    added: list[str] = []

    def listen(event: object) -> None:
        if isinstance(event, FrameOffered) and isinstance(event.answer, Added):
            added.append(event.name)

    part = map_sequence(today, CONFIG, listen, onto=first, should_stop=lambda: len(added) >= 5)
    assert part.interrupted
    resumed = map_sequence(today, CONFIG, onto=tm.load_map(saved), resume_from=part.map)
    whole = tm.load_map(saved)
    assert_same_map(resumed.map, map_sequence(today, CONFIG, onto=whole).map)
    with pytest.raises(DatasetError, match="cannot resume"):
        map_sequence(today, CONFIG, resume_from=part.map)


def test_what_was_frozen_counts_as_evidence_only(saved: Path) -> None:
    m = tm.load_map(saved)
    for id in list(m.keyframes):
        m.freeze_keyframe(id)
    m.infer()
    centres, _ = m.voxels()
    joined = map_sequence(where_it_is(recorded(TODAY[:4]), m), CONFIG, onto=m)
    assert joined.before == len(YESTERDAY)
    assert len(joined.map.keyframes) == 4
    assert (joined.map.state(centres) == tm.OCCUPIED).mean() > 0.95
    alone = map_sequence(recorded(TODAY[:4]), CONFIG).map
    assert (alone.state(centres) == tm.OCCUPIED).mean() < 0.7


def test_a_map_whose_keyframes_are_all_frozen_is_found_by_its_voxels(saved: Path) -> None:
    m = tm.load_map(saved)
    freeze_all(m)
    m.infer()
    placed = placed_in(m, "yesterday", recorded(TODAY, turned_away()))
    assert placed.later_s == 0
    for index, frame in enumerate(recorded(TODAY).frames):
        turned_rad, shifted_m = tangent_norms(frame.T_world_camera, placed.pose(index))
        assert shifted_m < CONFIG.voxel_size
        assert np.degrees(turned_rad) < 2
    assert placed_in(m, "yesterday", recorded(YESTERDAY)).frame_names[0] == "2:frame-000"


def test_todays_world_is_taken_to_the_maps(saved: Path) -> None:
    m, T_today_room = tm.load_map(saved), turned_away()
    today = placed_in(m, "yesterday", recorded(TODAY, T_today_room))
    assert any(note.startswith("Located in yesterday: ") and "agrees" in note for note in today.notes)
    for index, frame in enumerate(recorded(TODAY).frames):
        placed = today.read(index)
        turned_rad, shifted_m = tangent_norms(frame.T_world_camera, placed.T_world_camera)
        assert shifted_m < 0.03
        assert np.degrees(turned_rad) < 0.5
        np.testing.assert_array_equal(placed.T_world_camera, today.pose(index))
        np.testing.assert_array_equal(placed.depth_m, frame.depth_m)
    report = today.located.to_json()
    np.testing.assert_allclose(report["T_map_recording"], today.T_map_recording)


def mirrored(dataset: Frames) -> Frames:
    """A recording of the mirror image of what another shows: a flat on the other side of the stairs."""
    M = np.diag([-1.0, 1.0, 1.0, 1.0])
    frames = [
        replace(frame, depth_m=frame.depth_m[:, ::-1].copy(), T_world_camera=M @ frame.T_world_camera @ M)
        for frame in dataset.frames
    ]
    return replace(dataset, frames=frames)


def test_a_mirror_image_of_which_some_views_fit_is_refused_by_the_others() -> None:
    around = 120
    m = map_sequence(recorded(range(0, around, 2), around=around), CONFIG).map
    flat = mirrored(recorded(range(1, around, 2), turned_away(), around=around))
    some = [locate(m, flat.frames[first : first + 10]) for first in range(0, 60, 10)]
    assert any(found.T_map_recording is not None for found in some)
    found = locate(m, flat)
    assert found.T_map_recording is None
    assert found.reason.startswith("another place: ")
    assert locate(m, recorded(range(1, around, 2), turned_away(), around=around)).T_map_recording is not None


class Running(Frames):
    """Frames that cannot be looked at before they are mapped, such as a robot's."""

    @property
    def endless(self) -> bool:
        return True


def test_a_run_that_was_located_in_a_mirror_image_is_doubted_by_what_it_maps(tmp_path: Path) -> None:
    """Only its first views are searched for, and they fit; those after them do not."""
    around, path = 120, tmp_path / "map.npz"
    map_sequence(recorded(range(0, around, 2), around=around), CONFIG).map.save(path)
    here = recorded(range(1, around, 2), turned_away(), around=around)
    for walk, is_wrong in ((mirrored(here), True), (here, False)):
        m = tm.load_map(path)
        stretches = (walk.frames[first:] for first in range(0, 30, 10))
        frames = next(each for each in stretches if locate(m, each[:10]).T_map_recording is not None)
        running = Running("the room", walk.camera, frames=frames)
        result = map_sequence(placed_in(m, "yesterday", running), CONFIG, onto=m, limit=30)
        assert result.doubt.startswith("the recording may have been located in a wrong place") == is_wrong
        assert (result.doubt in run_report(result, running, "", None)["notes"]) == is_wrong


def test_a_tracked_recording_is_found_by_its_own_small_map(saved: Path) -> None:
    m, T_today_room = tm.load_map(saved), turned_away(1)
    steps = range(2 * COUNT)
    walk = recorded(steps, T_today_room, name="walk", tracked=True, around=100)
    joined = map_sequence(placed_in(m, "yesterday", walk), CONFIG, onto=m)
    assert joined.track is not None
    found = joined.track.poses(joined.map)
    assert len(found) == len(steps)
    true = recorded(steps, around=100)
    for index, T in found.items():
        assert tangent_norms(T, true.pose(index))[1] < CONFIG.voxel_size / 2


def test_frames_of_the_same_name_and_an_earlier_clock_get_others(saved: Path) -> None:
    m = tm.load_map(saved)
    again = placed_in(m, "yesterday", recorded(YESTERDAY, turned_away()))
    assert list(again.frame_names) == [f"2:frame-{index:03d}" for index in YESTERDAY]
    newest_s = max(keyframe.stamp_s for keyframe in m.keyframes.values())
    assert again.stamps()[0] > newest_s
    assert any("clock" in note for note in again.notes)
    assert again.read(3).stamp == again.stamps()[3]
    assert again.read(3).name == again.frame_names[3]
    both = map_sequence(again, CONFIG, onto=m, limit=3).map
    assert {keyframe.stamp_s for keyframe in both.keyframes.values()} > {float(i) for i in YESTERDAY}
    third = placed_in(both, "yesterday", recorded(YESTERDAY))
    assert third.frame_names[0] == "3:frame-000"
    later = placed_in(m, "yesterday", recorded(TODAY[-6:], name="other"))
    assert later.frame_names[0].startswith("other")


def test_the_samples_of_an_imu_move_with_their_frame(saved: Path) -> None:
    source = recorded(YESTERDAY, turned_away())
    stamps_s, rows = np.array([-0.1, 0.0]), np.ones((2, 3))
    gyro, acceleration = GyroSamples(stamps_s, rows), AccelerationSamples(stamps_s, rows, np.zeros(3))
    source.frames = [replace(frame, gyro=gyro, acceleration=acceleration) for frame in source.frames]
    placed = placed_in(tm.load_map(saved), "yesterday", source)
    assert placed.later_s > 0
    frame = placed.read(0)
    for samples in (frame.gyro, frame.acceleration):
        assert samples is not None
        np.testing.assert_array_equal(samples.stamps_s, stamps_s + placed.later_s)


def test_names_without_an_end_keep_their_prefix() -> None:
    source = recorded(TODAY)
    endless = replace(where_it_is(source, MRFMap(0.1)), prefix="2:")
    assert endless.frame_names[0] == f"2:{source.frame_names[0]}"
    assert EndlessNames("2:camera-")[7] == "2:camera-000007"


def test_a_half_life_keeps_the_dates_of_yesterday(tmp_path: Path) -> None:
    """A stool that came between the days: seen as of today, not as of yesterday."""
    config = replace(CONFIG, time=TimeConfig(half_life_s=10.0))
    path = tmp_path / "map.npz"
    map_sequence(recorded(YESTERDAY), config).map.save(path)
    m = tm.load_map(path)
    then_s = m.now_s
    today = placed_in(m, "yesterday", recorded(TODAY, turned_away(), STOOL, "today"))
    joined = map_sequence(today, config, onto=m).map
    seat = np.array([[0.2, 1.0, 0.45]]) + np.array(ROOM_IN_WORLD)
    assert joined.state(seat)[0] == tm.OCCUPIED
    assert joined.at(then_s).state(seat)[0] != tm.OCCUPIED


def test_a_recording_of_another_room_names_the_map(saved: Path) -> None:
    dataset = recorded(TODAY)
    dataset.frames = [replace(f, depth_m=np.full_like(f.depth_m, 1.3)) for f in dataset.frames]
    with pytest.raises(DatasetError, match=r"^the room: not found in yesterday\.npz: "):
        placed_in(tm.load_map(saved), "yesterday.npz", dataset)


def test_maps_that_align_nothing_are_refused(saved: Path) -> None:
    frames = recorded(TODAY).frames
    with pytest.raises(ConfigError, match="mrf, not log_odds"):
        locate(LogOddsMap(0.1), frames)
    with pytest.raises(ConfigError, match="neither keyframes nor"):
        locate(MRFMap(0.1), frames)
    refined, m = replace(CONFIG, poses=PoseConfig(refine=True)), tm.load_map(saved)
    today = where_it_is(recorded(TODAY), m)
    with pytest.raises(ConfigError, match=r"poses\.refine"):
        map_sequence(today, refined, onto=m)


def test_the_parameters_are_those_of_the_map() -> None:
    of_map = Config(voxel_size=0.02, keyframes=KeyframeConfig(translation=0.3))
    same = parameters_onto(of_map, Config(), Config(), "map.npz")
    assert same == of_map
    asked = Config(keyframes=KeyframeConfig(rotation=0.1))
    changed = parameters_onto(of_map, asked, Config(), "map.npz")
    assert changed.keyframes == KeyframeConfig(rotation=0.1, translation=0.3)
    assert changed.voxel_size == 0.02
    with pytest.raises(ConfigError, match=r"^map\.npz: was made with another voxel_size"):
        parameters_onto(of_map, Config(voxel_size=0.1), Config(), "map.npz")
    assert parameters_onto(of_map, Config(voxel_size=0.02), Config(), "map.npz") == of_map


def test_the_recordings_place_is_the_inverse_of_its_motion(saved: Path) -> None:
    T_today_room = turned_away(5)
    found = tm.locate(tm.load_map(saved), recorded(TODAY, T_today_room))
    assert found.T_map_recording is not None, found.reason
    assert len(found.frames) == 10
    assert tangent_norms(found.T_map_recording @ T_today_room, np.eye(4))[1] < 0.1
    assert tangent_norms(inverse(found.T_map_recording), T_today_room)[1] < 0.2
