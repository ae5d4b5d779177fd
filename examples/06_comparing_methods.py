"""Three mapping methods on the same keyframes, evaluated on held-out views.

    python examples/06_comparing_methods.py

All maps have the same methods, so any of them can replace another in a program.
"""

import numpy as np

import taichi_mrf as tm


def main() -> None:
    tm.init()
    frames = list(tm.open_dataset("synthetic:room?frames=16&width=160&height=120"))
    maps = {
        "MRFMap": tm.MRFMap(voxel_size=0.05),
        "OctoMap-style log-odds": tm.LogOddsMap(voxel_size=0.05),
        "visibility map": tm.VisibilityMap(voxel_size=0.05),
    }
    print(f"{'method':24} {'1.5 voxels':>10} {'5 cm':>6} {'occupied voxels':>16}")
    for name, m in maps.items():
        for frame in frames[::2]:
            m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
        m.infer()
        scores = {
            tolerance: np.mean(
                [
                    tm.accuracy(m, f.depth_m, f.T_world_camera, f.camera, tolerance=tolerance).score
                    for f in frames[1::2]
                ]
            )
            for tolerance in ("1.5sigma", "5cm")
        }
        occupied = len(m.voxels(min_probability=0.5)[1])
        print(f"{name:24} {scores['1.5sigma']:10.3f} {scores['5cm']:6.3f} {occupied:16d}")


if __name__ == "__main__":
    main()
