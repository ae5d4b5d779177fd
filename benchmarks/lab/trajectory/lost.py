"""A camera that is covered and then uncovered: whether it is found again, and what becomes of the map.

It walks through the built-in room, is covered for some frames, and goes on where it was, or at a place that
it has seen before, or at one that it has never seen, where it must not be found.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.lab.trajectory.following import map_figures
from benchmarks.lab.trajectory.walks import HOLD_OUT, CameraPath, Walk, ring_walk, room_walk, small_camera
from taichi_mrf.config.schema import Config
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.tables import Entry
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.mapping.intake import Intake
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame

RATE = 10.0
BEFORE, COVERED, AFTER = 65, 50, 20
"""Frames of the walk before the camera is covered, of the cover, and after it."""

WRONG_M = 0.2
"""A frame further off than this was found at another place."""

BETWEEN_S = 0.5 / RATE
"""The camera comes back between two places of the walk before."""

SAME, SEEN, UNSEEN = (
    "uncovered where it was",
    "carried to a place seen before",
    "carried to a place never seen",
)
PLACES: dict[str, tuple[Callable[[Path], CameraPath], float]] = {
    SAME: (room_walk, BEFORE / RATE),
    SEEN: (room_walk, 3.0 + BETWEEN_S),
    UNSEEN: (lambda data: ring_walk(False, data), 20.0),
}
"""Case -> the path on which the camera goes on, and the seconds from its beginning."""

COLUMNS = [
    "camera", "voxels", "poses by", "found covered", "map kept", "found after", "of these wrong",
    "first after (frames)", "error before (cm)", "error after (cm)", "5cm before", "5cm after",
]  # fmt: skip
NOTES = (
    f"The built-in room at {RATE:g} Hz: {BEFORE} frames, {COVERED} with a hand before it, {AFTER} "
    f"more. Found: frames that tracking gives a pose to; wrong: those over {WRONG_M:g} m off. At a place "
    "never seen none can be found.",
    "Map kept: after the covered frames the marginals are what they were before, bit for bit. Errors: of the "
    "last frame before the cover, and RMS of the frames found after it.",
    "5cm: held-out views of the walk before, judged by the map before the cover and by that at the end.",
)


def lost_result(experiment: Experiment, case: str, config: Config) -> Result:
    """Result for a camera in one of PLACES."""
    seed = experiment.seeds[0]
    path, (other, start_s) = room_walk(experiment.data), PLACES[case]
    shots = [path.frame(i / RATE, f"room-{i:04d}", (seed, i)) for i in range(BEFORE)]
    clean = {i: clean_m for i, (_, clean_m) in enumerate(shots) if is_held_out(i + 1, HOLD_OUT)}
    walk = Walk("room", small_camera(), frames=[frame for frame, _ in shots], clean_m=clean)
    last = walk.frames[-1]
    covered = [replace(last, depth_m=_hand(i), name=f"covered-{i:02d}") for i in range(COVERED)]
    there = other(experiment.data)
    after = [
        there.frame(start_s + i / RATE, f"after-{i:02d}", (seed + 1, BEFORE + i))[0] for i in range(AFTER)
    ]

    intake = Intake(create_map(config, walk.camera), config, tracked=True, hold_out=HOLD_OUT)
    m, track = intake.map, intake.result.track
    assert track is not None
    _offer(intake, walk.frames, 0)
    m.infer()
    before = map_figures(m, walk, track.poses(m))
    m.infer()  # judging has added views and taken them away
    error_before = _errors_m(track.poses(m), walk.frames, 0)[-1]
    marginals = m.marginals.voxels(0.0)
    _offer(intake, covered, BEFORE)
    centers, probability = m.marginals.voxels(0.0)
    kept = np.array_equal(centers, marginals[0]) and np.array_equal(probability, marginals[1])
    found_covered = sum(index >= BEFORE for index in track.frames)
    _offer(intake, after, BEFORE + COVERED)
    found = sorted(index - BEFORE - COVERED for index in track.frames if index >= BEFORE + COVERED)
    m.infer()
    errors = _errors_m(track.poses(m), after, BEFORE + COVERED)
    return {
        "found_covered": found_covered,
        "map_kept": kept,
        "found": len(found),
        "wrong": sum(error > WRONG_M for error in errors),
        "first": found[0] if found else None,
        "error_before_m": error_before,
        "error_after_m": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
        "before": before,
        "after": map_figures(m, walk, track.poses(m)),
    }


def lost_entries(result: Result) -> list[Entry]:
    """The part of a row that a result gives."""
    after_m = result["error_after_m"]
    return [
        result["found_covered"],
        "yes" if result["map_kept"] else "no",
        result["found"],
        result["wrong"],
        result["first"],
        100 * result["error_before_m"],
        None if after_m is None else 100 * after_m,
        *(result[when].get("5cm") for when in ("before", "after")),
    ]


def _offer(intake: Intake, frames: Iterable[Frame], first: int) -> None:
    """Frames in their order, with stamps that go on from those before them."""
    for index, frame in enumerate(frames, start=first):
        intake.offer(replace(frame, stamp=index / RATE), index + 1, index)


def _errors_m(poses: Mapping[int, Pose], frames: Sequence[Frame], first: int) -> list[float]:
    """By how many metres the frames that were found are off."""
    return [
        tangent_norms(frame.T_world_camera, poses[index])[1]
        for index, frame in enumerate(frames, start=first)
        if index in poses
    ]


def _hand(number: int) -> NDArray[np.float32]:
    """The depth, (H, W) in metres, of a hand before the camera: too near to be measured, or not quite."""
    rows, columns = np.mgrid[: small_camera().height, : small_camera().width]
    surface = 0.45 + 0.002 * columns + 0.001 * rows + 0.01 * np.sin(number)
    return np.where(number % 2 == 1, surface, 0.0).astype(np.float32)
