"""Half an hour of the built-in room in a loop, with one client that takes all it is sent: is the memory flat?

    python tests/support/live_soak.py --minutes 30 --csv runs/soak.csv

The keyframes are frozen as they age. Ends with status 1 if the memory of one of the two processes, as the
median of each minute, has moved by more than 5 % from what it was after the first five minutes. A single
sample may fall into a moment in which some temporary array lives; the largest one is printed too.
"""

import argparse
import csv
import statistics
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from live_program import LiveProgram
from raw_viewer_client import camera_message, raw_client
from websockets.exceptions import ConnectionClosed

INTERVAL_S = 10.0
WARM_UP_S = 300.0
MOST_DEVIATION = 0.05
SAMPLES_A_MINUTE = 6

OPTIONS = ("synthetic:room", "--loop", "--keep-live", "24")


@dataclass(frozen=True)
class Sample:
    """Resident memory of both processes at one moment, in MB."""

    seconds: float
    mapper: float
    viewer: float
    received: float
    """MB that the client has got since the beginning."""


def memory_mb(pid: int) -> float:
    """Resident memory of a process, MB. Its proportional share (PSS) would move whenever another program
    that uses the same libraries comes or goes."""
    fields = dict(
        line.split(":", 1)
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
        if ":" in line
    )
    return int(fields["Rss"].split()[0]) / 1024


class Drain:
    """A client on a thread of its own, which reads and forgets."""

    def __init__(self, port: int) -> None:
        self.received, self.lost = 0, ""
        self._thread = threading.Thread(target=self._read, args=(port,), daemon=True)
        self._thread.start()

    def _read(self, port: int) -> None:
        try:
            with raw_client(port) as client:
                client.say(camera_message())
                for frame in client.connection:
                    self.received += len(frame)
            self.lost = "the viewer has closed the connection"
        except (OSError, ConnectionClosed) as error:
            self.lost = str(error)


def deviation(values: list[float]) -> float:
    """The largest distance of any minute's median from that of the first one, in parts of that."""
    minutes = range(0, len(values) - SAMPLES_A_MINUTE + 1, SAMPLES_A_MINUTE)
    medians = [statistics.median(values[i : i + SAMPLES_A_MINUTE]) for i in minutes]
    return max(abs(median - medians[0]) for median in medians) / medians[0]


def soak(minutes: float, to: Path, options: tuple[str, ...]) -> list[Sample]:
    """Run the program for so long; every sample is also a line of the file ``to``."""
    to.parent.mkdir(parents=True, exist_ok=True)
    samples: list[Sample] = []
    with LiveProgram(*options) as program, to.open("w", newline="", encoding="utf-8") as file:
        viewer = next(pid for pid, command in program.group().items() if "spawn_main" in command)
        drain = Drain(program.port)
        writer = csv.writer(file)
        writer.writerow(Sample.__dataclass_fields__)
        begin = time.monotonic()
        while time.monotonic() < begin + 60 * minutes:
            time.sleep(INTERVAL_S)
            if drain.lost:
                raise SystemExit(f"the client was lost: {drain.lost}; the program said {program.said}")
            seconds, received = time.monotonic() - begin, drain.received / 1e6
            sample = Sample(seconds, memory_mb(program.pid), memory_mb(viewer), received)
            samples.append(sample)
            writer.writerow([f"{value:.1f}" for value in vars(sample).values()])
            file.flush()
    return samples


def main() -> int:
    """Run, print what was found, and say by the exit status whether it is good."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--csv", type=Path, default=Path("runs/soak.csv"))
    arguments = parser.parse_args()
    samples = soak(arguments.minutes, arguments.csv, OPTIONS)
    warm = [sample for sample in samples if sample.seconds >= WARM_UP_S]
    print(f"{len(samples)} samples in {arguments.csv}, the client has got {samples[-1].received:,.0f} MB")
    for name in ("mapper", "viewer"):
        values = [getattr(sample, name) for sample in samples]
        print(
            f"{name}: {values[0]:.0f} MB at first, {max(values):.0f} MB at most, {values[-1]:.0f} MB at last"
        )
    if len(warm) < 2 * SAMPLES_A_MINUTE:
        print(f"too short to judge: the first {WARM_UP_S / 60:.0f} minutes do not count")
        return 0
    largest = {name: deviation([getattr(sample, name) for sample in warm]) for name in ("mapper", "viewer")}
    for name, share in largest.items():
        print(f"{name}: largest deviation after the first five minutes {share:.1%}")
    return int(max(largest.values()) > MOST_DEVIATION)


if __name__ == "__main__":
    sys.exit(main())
