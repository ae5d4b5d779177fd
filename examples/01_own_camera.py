"""Map depth images of your own camera from its four intrinsics and its poses.

    python examples/01_own_camera.py

Replace the lines of the loop by your own depth images (metres along the optical axis, 0 or NaN for no
measurement) and poses (4 x 4, from the camera frame, x right, y down, z forward, to the world frame).
"""

import numpy as np

import taichi_mrf as tm


def main() -> None:
    tm.init()
    camera = tm.PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
    m = tm.MRFMap(voxel_size=0.05)

    # The camera moves 60 cm towards a wall at z = 3 m with a box in front of it.
    for step in range(4):
        T_world_camera = np.eye(4)
        T_world_camera[2, 3] = 0.2 * step
        m.add_keyframe(look(camera, T_world_camera), T_world_camera, camera)

    report = m.infer()
    centres, probability = m.voxels(min_probability=0.5)
    print(f"{len(centres)} occupied voxels after {report.sweeps} sweeps, {report.seconds:.2f} s")
    print(f"their mean probability is {probability.mean():.2f}")

    points = [[0.0, 0.0, 1.0], [0.0, 0.0, 3.02], [0.0, 0.0, 5.0]]
    names = {tm.UNKNOWN: "unknown", tm.FREE: "free", tm.OCCUPIED: "occupied"}
    for point, state in zip(points, m.state(points), strict=True):
        print(point, "is", names[int(state)])
    m.save("own_camera.npz")
    print("saved own_camera.npz; look at it with: taichi-mrf live own_camera.npz")


def look(camera: tm.PinholeCamera, T_world_camera: np.ndarray) -> np.ndarray:
    """Axial depth of a wall at z = 3 m and of a box, 1 m wide, whose front is at z = 2.5 m and x > 0.3 m."""
    rays = camera.rays()  # (H, W, 3), one metre along the optical axis
    ahead = T_world_camera[2, 3]
    at_box = rays * (2.5 - ahead) + T_world_camera[:3, 3]
    box = (at_box[..., 0] > 0.3) & (at_box[..., 0] < 1.3) & (np.abs(at_box[..., 1]) < 0.5)
    return np.where(box, 2.5 - ahead, 3.0 - ahead).astype(np.float32)


if __name__ == "__main__":
    main()
