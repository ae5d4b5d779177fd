"""How long ``taichi-mrf live`` takes to end after a signal, while real websocket clients ask for work.

    python tests/support/signal_timing.py --settle 20 -- synthetic:room --voxel-size 0.05

Per case: the map settles (--settle: for how long at most), the clients ask (150 presses of Save; or 20
clients that move a keyframe for 8 s; or nothing), then the signal is sent. Prints one line a case with the
seconds from the signal to the end of the program, its exit status, and the files that it left.
"""

import argparse
import contextlib
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from live_program import LiveProgram, wait_for
from raw_viewer_client import RawClient, camera_message, decode_frame, raw_client, widget_message
from websockets.exceptions import ConnectionClosed

CLIENTS, MOVING_S, PRESSES = 20, 8.0, 150
UNDER_BUDGET_S = 0.05
"""Between two messages of a client: it may send only so many a second."""


def widget(client: RawClient, label: str) -> str:
    """The name of the widget with this label."""
    found = client.hear(lambda each: (each.get("props") or {}).get("label") == label)
    return str(found["uuid"])


def press_save(program: LiveProgram) -> Callable[[], None]:
    """150 presses of Save by one client, which keeps its connection and reads on."""
    drain = _Client(program.port)
    button = widget(drain.client, "Map")
    drain.read_on()
    for _ in range(PRESSES):
        drain.say(widget_message(button, True))
        time.sleep(UNDER_BUDGET_S / 5)
    return drain.close


def move_keyframe(program: LiveProgram) -> Callable[[], None]:
    """20 clients that move the first keyframe to and fro for 8 s."""
    clients = [_Client(program.port) for _ in range(CLIENTS)]
    boxes = [widget(each.client, "Position (m)") for each in clients]
    for each in clients:
        each.read_on()
    until = time.monotonic() + MOVING_S
    number = 0
    while time.monotonic() < until:
        for each, box in zip(clients, boxes, strict=True):
            number += 1
            each.say(widget_message(box, [0.01 * (number % 97), 0.02 * (number % 31), 0.3]))
        time.sleep(UNDER_BUDGET_S)
    return lambda: [each.close() for each in clients] and None


def nothing(program: LiveProgram) -> Callable[[], None]:
    """One client looks at the page."""
    drain = _Client(program.port)
    drain.read_on()
    time.sleep(1.0)
    return drain.close


CASES = {"idle": nothing, "save": press_save, "move": move_keyframe}
SIGNALS = {"TERM": signal.SIGTERM, "INT": signal.SIGINT, "HUP": signal.SIGHUP}


class _Client:
    """A websocket client that reads all that it is sent on a thread of its own, once told to."""

    def __init__(self, port: int) -> None:
        self._context = raw_client(port)
        self.client = self._context.__enter__()
        self.client.say(camera_message())
        self.settled = False

    def read_on(self) -> None:
        threading.Thread(target=self._read, daemon=True).start()

    def say(self, message: dict[str, object]) -> None:
        with contextlib.suppress(ConnectionClosed):
            self.client.say(message)

    def close(self) -> None:
        with contextlib.suppress(ConnectionClosed, OSError):
            self._context.__exit__(None, None, None)

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed, OSError):
            for frame in self.client.connection:
                if not self.settled:
                    self.settled = "is up to date" in str(decode_frame(frame))


def _wait_until_settled(program: LiveProgram, patience_s: float) -> None:
    """Wait until the page says that the map is up to date, or for so many seconds."""
    client = _Client(program.port)
    client.read_on()
    until = time.monotonic() + patience_s
    while not client.settled and time.monotonic() < until:
        time.sleep(0.1)
    client.close()


def measure(options: list[str], case: str, number: signal.Signals, settle_s: float) -> str:
    """One line: what was asked, the signal, the seconds until all ended, the status and the files."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        with LiveProgram(*options, "--out", out) as program:
            _wait_until_settled(program, settle_s)
            close = CASES[case](program)
            begin = time.monotonic()
            os.kill(program.pid, number)
            status = program.wait()
            ended = time.monotonic() - begin
            wait_for(lambda: not program.group(), "the end of all processes")
            close()
            files = sorted(each.name for each in out.iterdir())
    return f"{case:5} SIG{number.name[3:]:5} {ended:5.1f} s  status {status}  {' '.join(files)}"


def main() -> int:
    """Measure every case with every signal."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--signals", nargs="+", choices=SIGNALS, default=list(SIGNALS))
    parser.add_argument("--settle", type=float, default=20.0, help="longest wait for the map, s")
    parser.add_argument("options", nargs="*", default=["synthetic:room"], help="what live is given, after --")
    arguments = parser.parse_args()
    for case in arguments.cases:
        for name in arguments.signals:
            print(measure(arguments.options, case, SIGNALS[name], arguments.settle), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
