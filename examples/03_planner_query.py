"""A planner's queries: is the straight path free, how far is the nearest obstacle, what would a scan see?

    python examples/03_planner_query.py

All queries take and return NumPy arrays, so a planner's whole tree of points is one call. Unknown space is
neither free nor occupied; an argument of the query says how to treat it.
"""

import numpy as np

import taichi_mrf as tm


def main() -> None:
    tm.init()
    m = tm.MRFMap(voxel_size=0.1)
    frames = list(tm.open_dataset("synthetic:room?frames=12&width=80&height=60"))
    for frame in frames:
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
    m.infer()

    # Is the path between two positions of the camera clear? One ray tests it; unknown space counts as a hit.
    start, goal = frames[0].T_world_camera[:3, 3], frames[4].T_world_camera[:3, 3]
    way = goal - start
    length = float(np.linalg.norm(way))
    (clear,) = ~tm.cast_rays(m, start[None], way[None], max_range=length, unknown="hit").hit
    print(f"the straight path of {length:.2f} m is {'clear' if clear else 'blocked'}")

    # The same for a robot with a size: the distance of the nearest obstacle along the path.
    steps = start + np.linspace(0, 1, 20)[:, None] * way
    field = tm.DistanceField(m, max_distance_m=1.0)
    distance, gradient = field.distance_and_gradient(steps)
    nearest = int(distance.argmin())
    away = gradient[nearest] / max(1e-9, np.linalg.norm(gradient[nearest]))
    print(
        f"its smallest clearance is {distance[nearest]:.2f} m; away from the obstacle is {np.round(away, 1)}"
    )

    # A fan of 360 rays around the start, as a laser scanner at that place would measure.
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    fan = np.stack([np.cos(angles), np.sin(angles), np.zeros(360)], axis=1)
    around = tm.cast_rays(m, start, fan, max_range=10.0, unknown="stop")
    print(f"{around.hit.sum()} of 360 rays meet a surface, {around.in_unknown.sum()} end in unknown space")
    print(f"the nearest surface is {around.range[around.hit].min():.2f} m away")


if __name__ == "__main__":
    main()
