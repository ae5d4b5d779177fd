"""Describe your sensor's noise and bias to the map, and compare the result with the defaults.

    python examples/02_own_sensor_model.py

The sensor here measures 3 cm too far at 2 m (its bias grows with depth), with a sigma of 1.5 cm. The wall is
at its true place only in the map whose noise model includes the bias. `taichi-mrf calibrate` learns such
polynomials, also for each patch of pixels, from your own recordings (docs/calibration.md).
"""

import numpy as np

import taichi_mrf as tm

WALL_M = 2.02
SIGMA = (0.015,)
BIAS = (0.0, 0.015)
"""Coefficients in ascending powers of depth, in metres: here 0.015 times the depth."""


def main() -> None:
    tm.init()
    camera = tm.PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
    random = np.random.default_rng(0)
    models = {
        "a Kinect's default": None,
        "own sigma": tm.PolynomialNoise(sigma=SIGMA),
        "own sigma and bias": tm.PolynomialNoise(sigma=SIGMA, bias=BIAS),
    }
    true_depth = np.full(camera.shape, WALL_M, np.float32)
    images = [
        (true_depth + BIAS[1] * WALL_M + random.normal(0, SIGMA[0], camera.shape)).astype(np.float32)
        for _ in range(6)
    ]
    for name, noise in models.items():
        m = tm.MRFMap(voxel_size=0.01, noise=noise)
        for depth_m in images:
            m.add_keyframe(depth_m, np.eye(4), camera)
        m.infer()
        seen = m.render_depth(camera, np.eye(4))
        error_cm = 100 * (np.nanmedian(seen) - WALL_M)
        score = tm.accuracy(m, true_depth, np.eye(4), camera, tolerance="1.5sigma").score
        print(f"{name:20} the wall is {error_cm:+.1f} cm off; {100 * score:.0f}% of the pixels are right")


if __name__ == "__main__":
    main()
