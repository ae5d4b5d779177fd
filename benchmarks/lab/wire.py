"""A live run of a robot, heard over its wire: is the map that of the bag, how late is it, does memory grow?

The kitchen's depth images and the building's scans become bags, without the frames that judge. A server of
Foxglove's own library plays them to `taichi-mrf live` as a person runs it, at their own pace and at three
times that. What it saves is compared, array by array, with what `map` makes of the frames that it took. In
the last part the kitchen is played again and again at 10 Hz, stamped with the present clock.
"""

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import numpy as np

import taichi_mrf as tm
from taichi_mrf.config.sections import LIVE_HALF_LIFE_S
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.scenes import Scene, kitchen_scene, lidar_scene
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.sensor.camera import PinholeCamera

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))  # whose robot and bags these are

HOLD_OUT = 10
QUIET_S = 10.0
"""A run that has taken no frame for so long takes no more of those that were sent."""

LAG_HZ, LAG_S, KEPT, SAMPLE_S = 10.0, 300.0, 48, 30.0
"""The last part: images a second, seconds, keyframes that can still be changed, seconds between samples."""

NOT_OF_THE_MAP = {"config", "manifest", "keyframe_names"}
"""Arrays in a map's file: the flags, checksums, and the numbers of frames, which count those left out."""

COLUMNS = (
    "images a second", "sent", "mapped", "equal to map BAG", "right", "of map BAG", "lag (ms)", "95%", "most",
    "processor (ms)", "MB at first", "MB at last",
)  # fmt: skip

TF = ("/tf", "/tf_static")


def run_wire(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One row for each recording and way to play it."""
    rows: list[list[Entry]] = []
    for scene_of, voxel_size in ((kitchen_scene, 0.05), (lidar_scene, 0.2)):
        part = "kitchen" if scene_of is kitchen_scene else "building"
        ways = [Way(1.0), Way(3.0), Way(1.0, drop=3)]
        ways += [Way(LAG_HZ / 3, lasts_s=LAG_S)] if part == "kitchen" else []
        for number, way in enumerate(ways):
            name = f"{part}, {way.in_words}"
            if not experiment.wants(name):
                continue
            experiment.report(name, number, len(ways))
            run = _Run(scene_of(experiment.data, experiment.limit), voxel_size, way)
            result = experiment.ledger.result(f"{name} | {experiment.limit}", run.result)
            rows.append([name, *(result[column] for column in COLUMNS)])
    notes = [
        f"Right: share of the held-out pixels (one frame in {HOLD_OUT}) whose likeliest surface lies within "
        "1.5 voxels of the measured depth.",
        "Lag: from an image's arrival until the map with it is sent to the page: median, 95%, most. "
        "Processor: time of both processes for each image that is mapped.",
        f"MB: resident memory of both processes, {KEPT} keyframes kept; at first: after a minute.",
    ]
    table = Table("wire", "A live run over Foxglove's protocol", ["run", *COLUMNS], rows, notes)
    return [table], write_table(experiment.out, table)


@dataclass(frozen=True)
class Way:
    """A way to play a bag: its ``pace`` over its own; without every ``drop``-th image; for ``lasts_s``
    seconds again and again, stamped with the present clock, if that is not 0."""

    pace: float
    drop: int = 0
    lasts_s: float = 0.0

    @property
    def in_words(self) -> str:
        dropped = f", every {self.drop}rd image dropped" if self.drop else ""
        return f"{LAG_HZ:g} Hz" if self.lasts_s else f"pace x {self.pace:g}{dropped}"


@dataclass
class _Run:
    """A live run of a scene. ``sent`` are the places in the bag of the images that were sent, ``usage`` the
    megabytes and processor seconds of all its processes, every SAMPLE_S seconds."""

    scene: Scene
    voxel_size: float
    way: Way
    sent: list[int] = field(default_factory=list)
    usage: list[tuple[float, float]] = field(default_factory=list)
    now_ns: int = 0

    def __post_init__(self) -> None:
        views = list(enumerate(self.scene.views, start=1))
        self.views = [view for number, view in views if not is_held_out(number, HOLD_OUT)]
        self.judged = [view for number, view in views if is_held_out(number, HOLD_OUT)]

    def result(self) -> Result:
        """The row's figures by their columns."""
        from foxglove_robot import robot

        with TemporaryDirectory() as name:
            folder = Path(name)
            events, saved = folder / "events", folder / "live"
            with robot(self._bag(folder, "all", range(len(self.views)))) as sender:
                self._live(sender, events, saved)
            taken, lags_s = _taken(events)
            if self.way.lasts_s:
                equal, right, of_bag = None, None, None
            else:
                bag = self._bag(folder, "taken", [self.sent[number] for number in taken])
                equal, right, of_bag = self._compared(saved / "map.npz", self._mapped(bag, folder / "bag"))
        rate_hz = (
            LAG_HZ
            if self.way.lasts_s
            else self.way.pace * (len(self.views) - 1) / self._seconds(len(self.views) - 1)
        )
        lags_ms = 1e3 * np.array(lags_s[1:])  # the first waits for what is compiled
        after_a_minute = self.usage[min(2, len(self.usage) - 1)][0]
        memory = (after_a_minute, self.usage[-1][0]) if self.way.lasts_s else (None, None)
        lags = (float(np.median(lags_ms)), float(np.quantile(lags_ms, 0.95)), float(lags_ms.max()))
        used_ms = 1e3 * (self.usage[-1][1] - self.usage[0][1]) / max(1, len(taken) - 1)
        print(*(f"{megabytes:.0f} MB, {used_s:.0f} s;" for megabytes, used_s in self.usage), file=sys.stderr)
        row = (rate_hz, len(self.sent), len(taken), equal, right, of_bag, *lags, used_ms, *memory)
        return dict(zip(COLUMNS, row, strict=True))

    def _bag(self, folder: Path, name: str, numbers: Any) -> Path:
        """A bag of some of the views: the pose at each image's own time, just before it."""
        from bag_clouds import send
        from inputs_bags import Bag, write_bag

        def play(bag: Bag) -> None:
            bag.tf("/tf_static", 0.0, "base", "sensor", np.eye(4))
            if isinstance(self.scene.camera, PinholeCamera):
                bag.camera_info("/camera/camera_info", "sensor", self.scene.camera)
            for number in numbers:
                view, at = self.views[number], 1.0 + self._seconds(number)
                bag.latency = 0.04
                bag.tf("/tf", at, "map", "base", view.T_world_camera)
                bag.latency = 0.05
                if isinstance(self.scene.camera, PinholeCamera):
                    depth_mm = np.rint(1000 * view.measured_m).astype(np.uint16)
                    bag.image("/camera/depth", at, "sensor", depth_mm, "16UC1")
                else:
                    rays = (view.camera or self.scene.camera).rays()
                    send(bag, at, rays * view.measured_m[..., None], frame="sensor")

        return Path(write_bag(folder, play, kind="mcap", name=name))

    def _seconds(self, number: int) -> float:
        return float(self.views[number].stamp_s or 0.0) - float(self.views[0].stamp_s or 0.0)

    def _live(self, sender: Any, events: Path, saved: Path) -> None:
        """Play the bag to a live run, until that has mapped it or takes no more."""
        from live_program import LiveProgram, wait_for

        events.touch()
        flags = ["--keep-live", str(KEPT)] if self.way.lasts_s else ["--out", str(saved)]
        start = ("-m", "benchmarks.lab.wire_events", str(events))
        first = Thread(target=self._send_first, args=(sender,))
        first.start()
        flags += ["--voxel-size", str(self.voxel_size), "--exit-when-done"]
        if not self.way.lasts_s:
            flags += ["--limit", str(len(self._to_send()))]
        with LiveProgram(sender.source, *flags, start=start) as program:
            first.join()
            wait_for(lambda: len(_of(events, "shown")) == 1, "the first keyframe")
            self._play(sender, lambda: self.usage.append(_usage(program.group())))
            if self.way.lasts_s or not _ends(program, events):
                program.end(signal.SIGINT)
            assert program.wait() in (0, 130), program.said

    def _to_send(self) -> list[int]:
        drop = self.way.drop
        return [number for number in range(len(self.views)) if not drop or number % drop != drop - 1]

    def _send_first(self, sender: Any) -> None:
        """What comes before the second image's pose, once somebody listens."""
        sender.wait_for(*sender.channels)
        time.sleep(0.5)  # the server notes who asks a moment after it says so
        topics = [topic for topic, _, _ in sender.messages]
        for message in sender.messages[: topics.index("/tf", topics.index("/tf") + 1)]:
            self._send(sender, *message)
        self.sent = [0]

    def _play(self, sender: Any, sample: Callable[[], None]) -> None:
        """Send the images after the first with their poses, each when it is due."""
        drop, lasts_s = set(range(len(self.views))) - set(self._to_send()), self.way.lasts_s
        start = next_sample = time.monotonic()
        for lap in range(10**6):
            number = -1
            for topic, logged_ns, data in sender.messages:
                number += topic == "/tf"
                image = topic not in ("/tf", "/tf_static", "/camera/camera_info")
                if lap == 0 and number <= 0:
                    continue
                place_s = (lap * len(self.views) + number) / LAG_HZ
                due_s = place_s if lasts_s else self._seconds(number) / self.way.pace
                time.sleep(max(0.0, start + due_s - time.monotonic()))
                if time.monotonic() >= next_sample:
                    sample()
                    next_sample += SAMPLE_S
                if not (image and number in drop):
                    self._send(sender, topic, logged_ns, data)
                    self.sent += [number] if image else []
                if lasts_s and time.monotonic() > start + lasts_s:
                    break
            if not lasts_s or time.monotonic() > start + lasts_s:
                break
        sample()

    def _send(self, sender: Any, topic: str, logged_ns: int, data: bytes) -> None:
        """Send a message; in the last part as of now, an image as of its pose."""
        if self.way.lasts_s:
            self.now_ns = time.time_ns() if topic in TF else self.now_ns
            logged_ns, changed = self.now_ns, bytearray(data)
            struct.pack_into("<iI", changed, 8 if topic in TF else 4, *divmod(logged_ns, 10**9))
            data = bytes(changed)
        sender.channels[topic].log(data, log_time=logged_ns)

    def _mapped(self, bag: Path, out: Path) -> Path:
        """The map that `map` makes of a bag, with the parameters of a live run."""
        command = [sys.executable, "-m", "taichi_mrf", "map", str(bag), "--out", str(out), "--quiet"]
        command += ["--voxel-size", str(self.voxel_size), "--time.half-life-s", str(LIVE_HALF_LIFE_S)]
        flags = ["--evaluation.hold-out", "0", "--noise", "given", "--no-pictures"]
        subprocess.run([*command, *flags], check=True)
        return out / "map.npz"

    def _compared(self, live: Path, of_bag: Path) -> tuple[str, float, float]:
        """Whether both maps hold the same arrays, and how well each predicts the held-out frames. The map of
        a run that was stopped is inferred first, as `map` does."""
        maps = [tm.load_map(live), tm.load_map(of_bag)]
        if not maps[0].settled:
            maps[0].infer()
            maps[0].save(live)
        with np.load(live) as ours, np.load(of_bag) as theirs:
            names = {*ours, *theirs} - NOT_OF_THE_MAP
            apart = [name for name in sorted(names) if not _same(ours, theirs, name)]
        return ", ".join(apart) or "yes", self._right(maps[0]), self._right(maps[1])

    def _right(self, m: Any) -> float:
        scores = [
            judge_view(
                m, view.true_m, view.T_world_camera, view.camera or self.scene.camera,
                noise=self.scene.noise, mask=view.judged, by="omega",
            ).accuracy("1.5sigma").score
            for view in self.judged
        ]  # fmt: skip
        return float(np.mean(scores))


def _same(ours: Any, theirs: Any, name: str) -> bool:
    """True if two maps' files have an array, bit for bit."""
    if name not in ours or name not in theirs:
        return False
    one, other = ours[name], theirs[name]
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


def _of(events: Path, kind: str) -> list[list[float]]:
    """The numbers of the events of a kind so far."""
    lines = (line.split() for line in events.read_text().splitlines(keepends=True) if line.endswith("\n"))
    return [[float(word) for word in words] for name, *words in lines if name == kind]


def _ends(program: Any, events: Path) -> bool:
    """Wait until a run has ended, or has taken no frame for QUIET_S; returns whether it has ended."""
    taken, since = -1, time.monotonic()
    while program.pid in program.group():
        now = len(_of(events, "taken"))
        if now != taken:
            taken, since = now, time.monotonic()
        if time.monotonic() > since + QUIET_S and not _of(events, "whole"):
            return False
        time.sleep(0.2)
    return True


def _taken(events: Path) -> tuple[list[int], list[float]]:
    """The numbers of the images that were taken, and the lags in seconds of those that are shown: from when
    one arrived until the last of what changed with it was written to the page's process."""
    taken, lags_s = _of(events, "taken"), []
    shown, put, sent = ([each[0] for each in _of(events, k)] for k in ("shown", "put", "sent"))
    done = [each[1] for each in _of(events, "sent")]
    for number, (arrived_s, begin_s, _) in enumerate(taken):
        after = taken[number + 1][1] if number + 1 < len(taken) else float("inf")
        end = next((s for s in shown if begin_s < s < after), None)
        puts = [p for p in put if end is not None and begin_s < p <= end]
        if puts:
            lags_s += [d - arrived_s for s, d in zip(sent, done, strict=True) if s >= puts[-1]][:1]
    return [int(number) for _, _, number in taken], lags_s


def _usage(processes: dict[int, str]) -> tuple[float, float]:
    """Megabytes in memory and seconds of processors of some processes together."""
    megabytes = used_s = 0.0
    for pid in processes:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        used_s += (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        megabytes += int(words[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return megabytes, used_s
