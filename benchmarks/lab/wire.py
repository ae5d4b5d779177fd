"""A live run of a robot, heard over its wire: is the map that of the bag, how late is it, does memory grow?

The kitchen's depth images and the building's scans become bags, without the frames that judge. A server of
Foxglove's own library plays them to `taichi-mrf live` as a person runs it, at their own pace and at three
times that. What it saves is compared, array by array, with what `map` makes of the frames that it took. The
kitchen is also played again and again at 10 Hz, stamped with the present clock.
"""

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import numpy as np

import taichi_mrf as tm
from taichi_mrf.config.sections import LIVE_HALF_LIFE_S
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, kitchen_scene, lidar_scene
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.sensor.camera import PinholeCamera

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))  # whose robot and bags these are

HOLD_OUT = 10
QUIET_S = 10.0
"""A run that has taken no frame for so long takes no more of those that were sent."""

KEPT, SAMPLE_S = 48, 60.0
"""Again and again: keyframes that can still be changed, and seconds between samples of memory."""

NOT_OF_THE_MAP = {"config", "manifest", "keyframe_names"}
"""Arrays in a map's file: the flags, checksums, and the numbers of frames, which count those left out."""

COLUMNS = (
    "images a second", "sent", "mapped", "equal to `map BAG`", "right", "lag (ms): median, 95%, most",
    "processors (ms)", "MB after a minute, at the end",
)  # fmt: skip

Message = tuple[int, str, int, bytes]
"""What is sent: the number of its image, topic, time in nanoseconds, and bytes."""

TF, IMAGES = ("/tf", "/tf_static"), ("/camera/depth", "/points")


@dataclass(frozen=True)
class Way:
    """A way to play a bag: its ``pace`` over its own; without every ``drop``-th image; for ``lasts_s``
    seconds again and again at ``rate_hz``, stamped with the present clock, if that is not 0."""

    pace: float = 1.0
    drop: int = 0
    lasts_s: float = 0.0
    rate_hz: float = 10.0


WAYS = {
    "": Way(),
    ", three times as fast": Way(pace=3.0),
    ", every third image dropped": Way(drop=3),
    ", again and again": Way(lasts_s=300.0),
}


def run_wire(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One row for each recording and way to play it: docs/results/wire.csv."""
    rows: list[list[Entry]] = []
    parts = {
        f"{part}{name}": (scene_of, voxel_size, way)
        for part, scene_of, voxel_size in (("kitchen", kitchen_scene, 0.05), ("building", lidar_scene, 0.2))
        for name, way in WAYS.items()
        if part == "kitchen" or not way.lasts_s
    }
    for number, (name, (scene_of, voxel_size, way)) in enumerate(parts.items()):
        if experiment.wants(name):
            experiment.report(name, number, len(parts))
            run = _Run(scene_of(experiment.data, experiment.limit), voxel_size, way)
            result = experiment.ledger.result(f"{name} | {experiment.limit}", run.result)
            rows.append([name, *(result[column] for column in COLUMNS)])
    notes = [
        f"Right: share of the held-out pixels (one frame in {HOLD_OUT}) whose likeliest surface lies within "
        "1.5 voxels of the measured depth.",
        "Lag: from an image's arrival until the map with it is sent to the page. "
        "Processors: time of both processes for each image that is mapped.",
        f"MB: resident memory of both processes, {KEPT} keyframes kept.",
    ]
    table = Table("wire", "A live run over Foxglove's protocol", ["played", *COLUMNS], rows, notes)
    return [table], write_table(experiment.out, table)


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
        begin_s = float(self.views[0].stamp_s or 0.0)
        self.stamps_s = [float(view.stamp_s or 0.0) - begin_s for view in self.views]

    def result(self) -> Result:
        """The row's figures by their columns."""
        from foxglove_robot import Robot

        way, equal, right, memory = self.way, "-", "-", "-"
        with TemporaryDirectory() as name:
            folder = Path(name)
            events, saved = folder / "events", folder / "live"
            with Robot(self._bag(folder, "all", range(len(self.views)))) as sender:
                self._live(sender, events, saved)
            taken, lags_s = _taken(events)
            if not way.lasts_s:
                bag = self._bag(folder, "taken", [self.sent[number] for number in taken])
                equal, right = self._compared(saved / "map.npz", self._mapped(bag, folder / "bag"))
        rate_hz = way.rate_hz if way.lasts_s else way.pace * (len(self.views) - 1) / self.stamps_s[-1]
        lags_ms = 1e3 * np.array(lags_s[1:])  # the first waits for what is compiled
        lags = np.median(lags_ms), np.quantile(lags_ms, 0.95), lags_ms.max()
        used_ms = 1e3 * (self.usage[-1][1] - self.usage[0][1]) / max(1, len(taken) - 1)
        if way.lasts_s:
            memory = f"{self.usage[1][0]:.0f}, {self.usage[-1][0]:.0f}"
        said = ", ".join(f"{lag:.0f}" for lag in lags)
        row = (f"{rate_hz:.1f}", len(self.sent), len(taken), equal, right, said, f"{used_ms:.0f}", memory)
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
                view, at = self.views[number], 1.0 + self.stamps_s[number]
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

    def _live(self, sender: Any, events: Path, saved: Path) -> None:
        """Play the bag to a live run, until that has mapped it or takes no more."""
        from live_program import LiveProgram, wait_for

        events.touch()
        messages = self._messages(sender)
        flags = ["--voxel-size", str(self.voxel_size), "--exit-when-done"]
        if self.way.lasts_s:
            flags += ["--keep-live", str(KEPT)]
        else:
            sent = sum(not self._is_dropped(number) for number in range(len(self.views)))
            flags += ["--out", str(saved), "--limit", str(sent)]
        first = Thread(target=self._send_first, args=(sender, messages))
        first.start()
        start = ("-m", "benchmarks.lab.wire_events", str(events))
        with LiveProgram(sender.source, *flags, start=start) as program:
            first.join()
            wait_for(lambda: len(_of(events, "shown")) == 1, "the first keyframe")
            self._play(sender, messages, lambda: self.usage.append(_usage(program.group())))
            if self.way.lasts_s or not _ends(program, events):
                program.end(signal.SIGINT)
            assert program.wait() in (0, 130), program.said

    def _is_dropped(self, number: int) -> bool:
        drop = self.way.drop
        return bool(drop) and number % drop == drop - 1

    def _messages(self, sender: Any) -> Iterator[Message]:
        """All that is sent, without the images that are dropped."""
        for lap in count() if self.way.lasts_s else range(1):
            number = lap * len(self.views) - 1
            for topic, logged_ns, data in sender.messages:
                number += topic == "/tf"
                if topic not in IMAGES or not self._is_dropped(number):
                    yield number, topic, logged_ns, data

    def _send_first(self, sender: Any, messages: Iterator[Message]) -> None:
        """What comes up to the first image, once somebody listens."""
        sender.wait_for(*sender.channels)
        time.sleep(0.5)  # the server notes who asks a moment after it says so
        while not self.sent:
            self._send(sender, next(messages))

    def _play(self, sender: Any, messages: Iterator[Message], sample: Callable[[], None]) -> None:
        """Send the images after the first with their poses, each when it is due."""
        start, way, next_sample = time.monotonic(), self.way, 0.0
        for message in messages:
            number = message[0]
            due_s = number / way.rate_hz if way.lasts_s else self.stamps_s[number] / way.pace
            if way.lasts_s and due_s > way.lasts_s:
                break
            time.sleep(max(0.0, start + due_s - time.monotonic()))
            if due_s >= next_sample:
                sample()
                next_sample += SAMPLE_S
            self._send(sender, message)
        sample()

    def _send(self, sender: Any, message: Message) -> None:
        """Send a message; again and again as of now, an image as of its pose."""
        number, topic, logged_ns, data = message
        if self.way.lasts_s:
            self.now_ns = time.time_ns() if topic in TF else self.now_ns
            logged_ns, changed = self.now_ns, bytearray(data)
            struct.pack_into("<iI", changed, 8 if topic in TF else 4, *divmod(logged_ns, 10**9))
            data = bytes(changed)
        sender.channels[topic].log(data, log_time=logged_ns)
        self.sent += [number] if topic in IMAGES else []

    def _mapped(self, bag: Path, out: Path) -> Path:
        """The map that `map` makes of a bag, with the parameters of a live run."""
        command = [sys.executable, "-m", "taichi_mrf", "map", str(bag), "--out", str(out), "--quiet"]
        command += ["--voxel-size", str(self.voxel_size), "--time.half-life-s", str(LIVE_HALF_LIFE_S)]
        flags = ["--evaluation.hold-out", "0", "--noise", "given", "--no-pictures"]
        subprocess.run([*command, *flags], check=True)
        return out / "map.npz"

    def _compared(self, live: Path, of_bag: Path) -> tuple[str, str]:
        """Which arrays of both maps differ, and how well the live map predicts the held-out frames. The map
        of a run that was stopped is inferred first, as `map` does."""
        m = tm.load_map(live)
        if not m.settled:
            m.infer()
            m.save(live)
        ours, theirs = _bits(live), _bits(of_bag)
        apart = [name for name in sorted({*ours, *theirs}) if ours.get(name) != theirs.get(name)]
        return ", ".join(apart) or "yes", f"{self._right(m):.3f}".removeprefix("0")

    def _right(self, m: Any) -> float:
        scores = [
            judge_view(
                m, view.true_m, view.T_world_camera, view.camera or self.scene.camera,
                noise=self.scene.noise, mask=view.judged, by="omega",
            ).accuracy("1.5sigma").score
            for view in self.judged
        ]  # fmt: skip
        return float(np.mean(scores))


def _bits(path: Path) -> dict[str, object]:
    """The arrays of a map's file, bit for bit."""
    with np.load(path) as arrays:
        names = set(arrays) - NOT_OF_THE_MAP
        return {name: (arrays[name].dtype, arrays[name].shape, arrays[name].tobytes()) for name in names}


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
