"""Move keyframes afterwards, as a SLAM back-end does when it closes a loop.

    python examples/04_loop_closure.py

Odometry drifts: in the second half of a walk around the built-in room, poses are wrong by up to 30 cm. When
the loop is closed, the poses are corrected. The map of the moved keyframes is equal, voxel by voxel, to the
map of keyframes that had the right poses from the start.
"""

import numpy as np

import taichi_mrf as tm


def main() -> None:
    tm.init()
    frames = list(tm.open_dataset("synthetic:room?frames=10&width=80&height=60"))
    drifted, right = tm.MRFMap(voxel_size=0.1), tm.MRFMap(voxel_size=0.1)
    ids = []
    for number, frame in enumerate(frames):
        drift = np.eye(4)
        drift[0, 3] = 0.3 * max(0, number - 4) / 5
        ids.append(drifted.add_keyframe(frame.depth_m, drift @ frame.T_world_camera, frame.camera))
        right.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
    drifted.infer()
    right.infer()
    print("before closing the loop:", compare(drifted, right))

    for id, frame in zip(ids, frames, strict=True):
        drifted.move_keyframe(id, frame.T_world_camera)
    drifted.infer()
    print("after closing the loop: ", compare(drifted, right))


def compare(m: tm.MRFMap, other: tm.MRFMap) -> str:
    """The share of occupied voxels that maps have in common, and the largest difference of probability."""
    centres, probability = other.voxels(min_probability=0.5)
    found = m.occupancy(centres)
    shared, largest = (found > 0.5).mean(), np.abs(found - probability).max()
    return f"{100 * shared:.1f}% of the occupied voxels shared, largest difference {largest:.3f}"


if __name__ == "__main__":
    main()
