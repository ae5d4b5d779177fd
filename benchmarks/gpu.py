"""All that is to be known of the map on a CUDA device, in one call of less than eight minutes.

    python benchmarks/gpu.py --json gpu.json

Runs the tests that use a backend, then measures, on frames of 640 x 480 of the built-in room, made on the
fly: a new keyframe with three sweeps at 2 and 1 cm (kernels by Taichi's profiler, and wall time), the share
of the memory's bandwidth that its kernels achieve, full inference of 100 keyframes at 1 cm, how often the
host waits for the device, distances to obstacles, and OctoMap on one CPU core. Each part is a process of its
own with a time of its own: a part that fails or takes too long is named, and the others still run. ``--arch
cpu --quick`` shows in a minute or two that the script works, and nothing else.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
TARGETS_MS = {0.02: 10.0, 0.01: 25.0}
FULL_TARGET_S, OCTOMAP_TARGET, DISTANCES_TARGET_MS = 3.0, 100.0, 1.0
TESTS = (
    "sum_product",
    "accumulators",
    "traversal",
    "topology",
    "pool",
    "ray_list",
    "forward",
    "queries_distance",
    "backends_agree",
)
SWEEPS = 3
LIMITS_S = {"tests": 130, "kernels": 90, "wall": 110, "distances": 60, "octomap": 90}
"""The parts, and how long each may take: less than eight minutes in all."""


@dataclass(frozen=True)
class Options:
    """Device to run on."""

    arch: str = "cuda"
    """The backend: cuda, or another to try the script out."""

    source: str = ""
    """A folder or a built-in sequence; default is the built-in room at 640 x 480."""

    quick: bool = False
    """Next to nothing of everything: coarse voxels, small images."""

    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write all figures to this file as well."""

    part: str = ""
    """Do this part alone, in this process: tests, kernels, wall, distances or octomap."""

    @property
    def voxel_sizes(self) -> tuple[float, ...]:
        return (0.2, 0.1) if self.quick else (0.02, 0.01)

    @property
    def keyframes(self) -> int:
        """Of the full inference."""
        return 4 if self.quick else 100

    @property
    def sequence(self) -> str:
        size = "width=64&height=48" if self.quick else "width=640&height=480"
        return self.source or f"synthetic:room?frames={self.keyframes}&{size}"


def run_all(options: Options) -> int:
    """Run each part within its time and print one table. 0 if all of them succeeded."""
    begin, report = time.perf_counter(), {}
    for name, seconds in LIMITS_S.items():
        report[name] = _run_part(options, name, seconds)
        print(f"{name}: {report[name].get('problem') or 'done'}", flush=True)
    report["seconds"] = time.perf_counter() - begin
    print("\n".join(_table(report, options)))
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return 1 if any("problem" in part for part in report.values() if isinstance(part, dict)) else 0


def _run_part(options: Options, name: str, seconds: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "part.json"
        flags = ["--arch", options.arch, "--part", name, "--json", str(out)]
        flags += ["--source", options.source] if options.source else []
        flags += ["--quick"] if options.quick else []
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        }
        try:
            # Ten times as long where it is only tried out: such a machine may have other things to do.
            limit = seconds * (10 if options.quick else 1)
            done = subprocess.run(
                [sys.executable, __file__, *flags], cwd=ROOT, env=environment, timeout=limit,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"problem": f"was stopped after {limit} s"}
        if done.returncode != 0 or not out.exists():
            last = (done.stdout.strip().splitlines() or ["no word"])[-1]
            return {"problem": f"status {done.returncode}: {last}", "output": done.stdout[-4000:]}
        return json.loads(out.read_text(encoding="utf-8"))


def tests(options: Options) -> dict[str, Any]:
    """The tests of kernels and maps that use a backend, on this one."""
    names = ("resident",) if options.quick else TESTS
    files = [str(next((ROOT / "tests").rglob(f"test_{name}.py"))) for name in names]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--arch", options.arch, *files]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    found = {"summary": done.stdout.strip().splitlines()[-1], "files": files}
    return (
        found
        if done.returncode == 0
        else found | {"problem": found["summary"], "output": done.stdout[-4000:]}
    )


def kernels(options: Options) -> dict[str, Any]:
    """Kernel times of a keyframe at each voxel size, by Taichi's profiler."""
    from benchmarks.speed.bandwidth import copy_bandwidth
    from benchmarks.speed.profile import profile_mapping
    from taichi_mrf.config.schema import Config

    device = _start(options, profile=options.arch != "vulkan")
    bandwidth = copy_bandwidth(1 << 24 if options.quick else 0)
    rows = []
    for size in options.voxel_sizes:
        frames, rate = _frames(options, 4 if options.quick else 20), bandwidth.bytes_per_second
        row = profile_mapping(frames, Config(voxel_size=size), rate, len(frames) // 2)
        seconds = {stage: sum(k.seconds for k in row.kernels if k.stage == stage) for stage in row.wall}
        moved = sum(k.floor_bytes or 0.0 for k in row.kernels if k.stage == "own_sweep")
        rows.append(
            row.to_json()
            | {
                "kernel_seconds": seconds["allocate"] + SWEEPS * seconds["own_sweep"],
                "bandwidth_share": moved / seconds["own_sweep"] / rate,
            }
        )
    return {"device": device, "bandwidth": dataclasses.asdict(bandwidth), "rows": rows}


def wall(options: Options) -> dict[str, Any]:
    """Wall time of a keyframe with three sweeps, and of full inference at the finest voxel size."""
    from benchmarks.speed.profile import count_launches
    from taichi_mrf.config.schema import Config
    from taichi_mrf.evaluation.keyframe_cost import Seconds, live_stages, timed, warm_up
    from taichi_mrf.methods.mrf.map import MRFMap

    device = _start(options)
    frames = _frames(options, options.keyframes)
    rows = []
    for size in options.voxel_sizes:
        config = Config(voxel_size=size)
        warm_up(MRFMap.from_config(config, frames[0].camera), frames)
        m = MRFMap.from_config(config, frames[0].camera)
        added, swept = [], []
        last = size == min(options.voxel_sizes)
        for frame in frames if last else frames[:20]:
            stages = live_stages(m, frame)
            added.append(timed(stages["allocate"]))
            keyframe = m.keyframes[max(m.keyframes)]
            with count_launches() as launches:
                m.infer(sweeps=1, keyframes=[keyframe.id])
            swept.append(timed(lambda: _sweep_again(m, keyframe)))  # noqa: B023
        median = Seconds.median([a + s for a, s in zip(added, swept, strict=True)][len(added) // 2 :])
        row = {"voxel_size": size, "seconds": median.wall, "waits_in_a_sweep": launches.waits}
        row |= {"launches_in_a_sweep": launches.number, "keyframes": len(m.keyframes)}
        if last:
            m.infer(sweeps=1)
            row["full_seconds"] = timed(m.infer).wall
        rows.append(row)
    return {"device": device, "rows": rows}


def _sweep_again(m: Any, keyframe: Any) -> None:
    """Three whole sweeps over one keyframe: as if others had changed what it is told before each."""
    for _ in range(SWEEPS):
        keyframe.revision = -1
        m.infer(sweeps=1, keyframes=[keyframe.id])


def distances(options: Options) -> dict[str, Any]:
    """Distances to obstacles at 10,000 points, and their update after a new keyframe."""
    import numpy as np

    from taichi_mrf.config.schema import Config
    from taichi_mrf.evaluation.keyframe_cost import Seconds, timed
    from taichi_mrf.methods.mrf.map import MRFMap
    from taichi_mrf.queries.distance import DistanceField

    device = _start(options)
    size, frames = max(options.voxel_sizes), _frames(options, 4 if options.quick else 18)
    m = MRFMap.from_config(Config(voxel_size=size), frames[0].camera)
    field, decided, updated = None, [], []
    for frame in frames:
        m.renew([m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)])
        decided.append(timed(m.decide))  # which voxels are occupied
        field = field or DistanceField(m, max_distance_m=25 * size)
        updated.append(timed(field.update))
    assert field is not None
    points = np.random.default_rng(0).uniform((-2, -2, 0), (2, 2, 2), (10_000, 3)).astype(np.float32)
    read = Seconds.median([timed(lambda: field.distance(points)) for _ in range(10)])
    half = len(frames) // 2
    return {
        "device": device,
        "voxel_size": size,
        "read_seconds": read.wall,
        "decide_seconds": Seconds.median(decided[half:]).wall,
        "update_seconds": Seconds.median(updated[half:]).wall,
    }


def octomap(options: Options) -> dict[str, Any]:
    """OctoMap on one CPU core, a ray for each pixel, at the finest voxel size."""
    from taichi_mrf.evaluation.bench import octomap_available, octomap_inserter

    if not octomap_available():
        return {"missing": "pip install 'taichi-mrf[bench]' brings OctoMap"}
    _start(options)
    insert = octomap_inserter(min(options.voxel_sizes))
    # One to warm up and one to time: at 1 cm a frame takes half a minute.
    times = [insert(frame) for frame in _frames(options, 2)]
    return {"seconds": times[-1].wall}


def _start(options: Options, profile: bool = False) -> str:
    from taichi_mrf.system import runtime

    runtime.init(options.arch, profile=profile)
    choice = runtime.choice()
    return f"{choice.name}, {choice.device}" if choice else ""


def _frames(options: Options, count: int) -> list[Any]:
    from taichi_mrf.datasets import open_dataset

    dataset = open_dataset(options.sequence, color=False)
    return [dataset.read(i) for i in range(min(count, len(dataset)))]


def _table(report: dict[str, Any], options: Options) -> list[str]:
    """The figures beside their targets; a part that has none says why."""
    kernel, clock, octo = report["kernels"], report["wall"], report["octomap"]
    lines = ["", f"device: {clock.get('device') or kernel.get('device') or 'unknown'}"]
    if options.arch != "cuda":
        lines.append("This is no CUDA device: the figures show that the script works, and no more.")
    lines.append(f"frames: {options.sequence}")
    lines.append(f"tests: {report['tests'].get('summary', 'no result')}")
    if "bandwidth" in kernel:
        rate = kernel["bandwidth"]
        lines.append(f"memory: {rate['bytes_per_second'] / 1e9:.1f} GB/s ({rate['how']})")
    for row in kernel.get("rows", []):
        least = TARGETS_MS.get(row["voxel_size"])
        lines.append(
            f"{_cm(row)}: a keyframe with {SWEEPS} sweeps, kernels {row['kernel_seconds'] * 1e3:.2f} ms"
            f"{_target(least, 'ms')}; a sweep's reach {100 * row['bandwidth_share']:.1f}% of the bandwidth"
        )
    for row in clock.get("rows", []):
        least = TARGETS_MS.get(row["voxel_size"])
        lines.append(
            f"{_cm(row)}: a keyframe with {SWEEPS} sweeps, wall-clock time {row['seconds'] * 1e3:.2f} ms"
            f"{_target(least, 'ms')}; a sweep has {row['launches_in_a_sweep']} launches, "
            f"{row['waits_in_a_sweep']} of which the host waits for"
        )
        if "full_seconds" in row:
            full = f"{_cm(row)}: {row['keyframes']} keyframes fully inferred, {row['full_seconds']:.2f} s"
            lines.append(full + _target(FULL_TARGET_S, "s"))
        if "full_seconds" in row and "seconds" in octo:
            lines.append(
                f"{_cm(row)}: OctoMap on one core {octo['seconds'] * 1e3:.0f} ms a frame, "
                f"{octo['seconds'] / row['seconds']:.0f} times a keyframe's (target: {OCTOMAP_TARGET:g})"
            )
    if "read_seconds" in report["distances"]:
        found = report["distances"]
        lines.append(
            f"{_cm(found)}: distances at 10,000 points {found['read_seconds'] * 1e3:.2f} ms"
            f"{_target(DISTANCES_TARGET_MS, 'ms')}; after a keyframe their update takes "
            f"{found['update_seconds'] * 1e3:.1f} ms, and which voxels are occupied "
            f"{found['decide_seconds'] * 1e3:.1f} ms"
        )
    for name, part in report.items():
        if isinstance(part, dict) and "problem" in part:
            lines.append(f"{name}: {part['problem']}")
    lines += [f"OctoMap: {octo['missing']}"] if "missing" in octo else []
    lines.append(f"{report['seconds']:.0f} s in all")
    return lines


def _cm(row: dict[str, Any]) -> str:
    return f"{row['voxel_size'] * 100:g} cm"


def _target(most: float | None, unit: str) -> str:
    return "" if most is None else f" (target: {most:g} {unit})"


PARTS: dict[str, Callable[[Options], dict[str, Any]]] = {
    "tests": tests,
    "kernels": kernels,
    "wall": wall,
    "distances": distances,
    "octomap": octomap,
}


def main() -> int:
    """All parts, or the one that this process is to do."""
    options = tyro.cli(Options, description=__doc__)
    if not options.part:
        return run_all(options)
    found = PARTS[options.part](options)
    if options.json is not None:
        options.json.write_text(json.dumps(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
