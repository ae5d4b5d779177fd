"""Whether Taichi's code or the machine is the limit of the ray kernel: the same loop in C++, the same rays.

Random rays go through a dense grid of random log-odds, once by taichi_mrf.inference.sum_product.send_messages
and once by walk.cpp, compiled with the system's compiler. Both must come to the same sums. Prints nanoseconds
for each voxel step, the best of five runs each:

    python benchmarks/walk.py
    python benchmarks/walk.py --rays 1000 --bricks 8 --json walk.json
"""

import json
import math
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

SIGMA_M, VOXEL_SIZE, FLOOR, CLAMP, SIGMAS = 0.05, 0.05, 1e-6, 6.9, 3.0
WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
RUNS = 5
AGREE = 0.999
"""Share of the voxels in which the two must come to the same sums."""

Json = Annotated[Path | None, tyro.conf.arg(name="json", metavar="FILE")]


def main(
    bricks: int = 16, rays: int = 100_000, threads: tuple[int, ...] = (1, 2), json_file: Json = None
) -> int:
    """Compare both. ``bricks`` along each side of the grid, a multiple of 8."""
    with tempfile.TemporaryDirectory() as folder:
        problem = Path(folder) / "problem"
        write_problem(problem, bricks, rays)
        program = compiled(Path(folder) / "walk")
        if program is None:
            print("There is no C++ compiler here (c++, g++ or clang++): only Taichi's kernel is timed.")
        rows = [measured(problem, program, number) for number in threads]
    for row in rows:
        print(row["text"])
    if json_file is not None:
        json_file.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return 0 if all(row["agree"] for row in rows) else 1


def write_problem(path: Path, bricks: int, count: int) -> None:
    """Random log-odds and rays, in the format that walk.cpp states, and the rays' pixels beside it."""
    rng = np.random.default_rng(0)
    side = bricks * 8
    log_free = -np.logaddexp(0.0, rng.normal(-3.0, 2.0, side**3)).astype(np.float32)
    pixels = np.sort(rng.choice(WIDTH * HEIGHT, count, replace=count > WIDTH * HEIGHT)).astype(np.int32)
    v, u = np.divmod(pixels, WIDTH)
    direction = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones(count)], axis=1)
    direction = (direction / VOXEL_SIZE).astype(np.float32)
    origin = np.array([side / 2 + 0.3, side / 2 + 0.4, 2.2], np.float32)
    # Every ray ends inside the grid: what lies beyond a map's edge is not what is to be timed.
    face = np.where(direction > 0, side - 0.5, 0.5)
    room = (face - origin) / np.where(np.abs(direction) < 1e-6, 1e-6 * (face - origin), direction)
    most = room.min(axis=1) - SIGMAS * SIGMA_M
    depth = (most * rng.uniform(0.4, 1.0, count)).astype(np.float32)
    end = depth + np.float32(SIGMAS * SIGMA_M)
    length = np.linalg.norm(direction, axis=1)
    scale = 2.0 ** math.floor(math.log2(2**31 / (math.sqrt(3) * count + 1)))
    table = np.column_stack([np.tile(origin, (count, 1)), direction, np.zeros(count), end, depth, length])
    with path.open("wb") as file:
        file.write(np.array([bricks, count], np.int32).tobytes())
        file.write(np.array([SIGMA_M, FLOOR, CLAMP, scale], np.float32).tobytes())
        file.write(log_free.tobytes())
        file.write(table.astype(np.float32).tobytes())
    np.savez(
        path.with_suffix(".npz"), pixels=pixels, depth=depth, log_free=log_free, origin=origin, scale=scale
    )


def compiled(program: Path) -> Path | None:
    """walk.cpp as a program; None if there is no compiler."""
    compiler = next((found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None)
    if compiler is None:
        return None
    source = Path(__file__).with_name("walk.cpp")
    options = ["-std=c++17", "-O3", "-march=native", "-pthread"]
    subprocess.run([compiler, *options, "-o", str(program), str(source)], check=True)
    return program


def measured(problem: Path, program: Path | None, threads: int) -> dict:
    """One row: both on so many threads. Each is a process of its own, because Taichi starts only once."""
    command = [sys.executable, __file__, "taichi", str(problem), str(threads)]
    answer = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    seconds, steps = map(float, answer.split()[-2:])
    row = {"threads": threads, "steps": int(steps), "taichi_ns": seconds / steps * 1e9, "agree": True}
    row["text"] = f"{threads} threads: Taichi {row['taichi_ns']:.1f} ns a voxel step ({steps:,.0f} steps)"
    if program is not None:
        answer = subprocess.run(
            [program, problem, str(threads)], check=True, stdout=subprocess.PIPE, text=True
        )
        seconds, steps = map(float, answer.stdout.split())
        row["cpp_ns"], row["cpp_steps"] = seconds / steps * 1e9, int(steps)
        same = agreement(np.load(f"{problem}.taichi.npy"), np.fromfile(f"{problem}.sums", np.int64), problem)
        row["agreement"], row["agree"] = same, same >= AGREE
        row["text"] += (
            f", C++ {row['cpp_ns']:.1f} ns, Taichi / C++ {row['taichi_ns'] / row['cpp_ns']:.2f}; "
            f"the same sums in {100 * same:.2f}% of the voxels"
        )
    return row


def agreement(a: np.ndarray, b: np.ndarray, problem: Path) -> float:
    """Share of the voxels in which both packed sums (accumulators.py) differ by next to nothing."""
    scale = float(np.load(problem.with_suffix(".npz"))["scale"])
    lengths = np.abs((a & 0xFFFFFFFF) - (b & 0xFFFFFFFF)) / scale
    messages = np.abs((a >> 32) - (b >> 32)) / scale
    size = 1.0 + (a & 0xFFFFFFFF) / scale
    return float(((lengths < 5e-3 * size) & (messages < 5e-3 * size)).mean())


def time_taichi(problem: Path, threads: int) -> None:
    """Run Taichi's kernel, leave its sums beside the problem, and print seconds and steps."""
    from taichi_mrf.inference import sum_product
    from taichi_mrf.inference.keyframe import RayList
    from taichi_mrf.inference.ray_list import BITS, RayLattice
    from taichi_mrf.inference.ray_model import RayModel, SweptVoxels, Trace
    from taichi_mrf.inference.sweep import TRACE_BYTES
    from taichi_mrf.inference.workers import workers_for
    from taichi_mrf.kernels.resident import vec4_array
    from taichi_mrf.sensor.camera import PinholeCamera
    from taichi_mrf.sensor.forward import CENTRE
    from taichi_mrf.sensor.noise import PolynomialNoise
    from taichi_mrf.system import runtime
    from taichi_mrf.system.compiler import ti
    from taichi_mrf.voxels.traversal import Space, Viewpoint

    runtime.init("cpu", threads)
    data = np.load(problem.with_suffix(".npz"))
    side = round(len(data["log_free"]) ** (1 / 3))
    bricks, count, longest = side // 8, len(data["pixels"]), 4 * side
    workers = workers_for("cpu", False, longest, TRACE_BYTES)
    begins = ti.ndarray(ti.f32, count)
    log_free, sums = ti.ndarray(ti.f32, side**3), ti.ndarray(ti.i64, side**3)
    log_free.from_numpy(data["log_free"])
    camera = PinholeCamera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    sensor = PolynomialNoise((SIGMA_M,)).table(camera).sensor(camera)
    view = Viewpoint(
        ti.Vector(data["origin"].tolist(), ti.f32), ti.Matrix((np.eye(3) / VOXEL_SIZE).tolist(), ti.f32)
    )
    space = Space(
        ti.Vector([bricks] * 3, ti.i32), ti.Vector([0.0] * 3, ti.f32), ti.Vector([float(side)] * 3, ti.f32),
        np.ones((bricks // 8) ** 3, np.int32), np.arange(bricks**3, dtype=np.int32),
    )  # fmt: skip
    model = RayModel(
        voxel_size=VOXEL_SIZE, max_depth=1e3, end_sigmas=SIGMAS, floor=FLOOR, clamp=CLAMP,
        pass_through=0.0, passes=False, likelihood=CENTRE,
        segment_lengths=True, log_average=True, maximise=False,
        sample=RayLattice.of(1), samples=False, scouts=RayLattice.of(1), thins=False,
        clear_sigmas=0.0, clear_voxels=0.0,
    )  # fmt: skip
    steps = np.zeros(workers.number, np.int32)
    rays = RayList(data["pixels"] << BITS, data["depth"], count, 1)
    swept = SweptVoxels(log_free, sums, float(data["scale"]))
    trace = Trace(
        ti.ndarray(ti.i32, workers.number * longest), vec4_array(workers.number * longest), longest, steps
    )
    best = math.inf
    for attempt in range(RUNS + 1):  # the first is compiled
        sums.fill(0)
        begins.fill(0.0)
        begin = time.perf_counter()
        sum_product.send_messages(rays, begins, 0, sensor, view, space, model, swept, trace, workers, False)
        ti.sync()
        if attempt > 0:
            best = min(best, time.perf_counter() - begin)
    np.save(f"{problem}.taichi.npy", sums.to_numpy())
    print(best, steps.sum())


if __name__ == "__main__":
    if sys.argv[1:2] == ["taichi"]:
        time_taichi(Path(sys.argv[2]), int(sys.argv[3]))
    else:
        sys.exit(tyro.cli(main))
