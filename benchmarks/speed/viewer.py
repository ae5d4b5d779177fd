"""Cost of a keyframe for the viewer: time on the server, and bytes to each browser.

The page's own parts are used with a real server and one client that only reads, so that the bytes are
those that went over the wire.
"""

import asyncio
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import viser
import websockets
from rich.table import Table
from websockets.asyncio.client import connect
from websockets.typing import Origin, Subprotocol

from taichi_mrf.cli.bench import BenchRun, Measured
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.geometry.up import up_of
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.publish import Publisher
from taichi_mrf.viewer.messages import Bricks, Hello
from taichi_mrf.viewer.scene.map_scene import MapScene
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.transport.server import start_server

_QUIET_S = 0.3
"""A client that has received nothing for this many seconds has received everything."""


@dataclass(frozen=True)
class ViewerRow:
    """One keyframe. ``publish`` is what the mapper spends on finding the changes, ``draw`` the page's thread
    on turning them into what is sent, both in seconds; ``changed`` is the number of bricks that were sent,
    ``sent`` the bytes that one browser got, ``shown`` the voxels of the map that the page then shows."""

    publish: float
    draw: float
    changed: int
    sent: int
    shown: int


def bench_viewer(
    frames: Sequence[Frame], config: Config, advance: Callable[[int], None] = lambda done: None
) -> list[ViewerRow]:
    """Map frames one by one as a live run does, and measure each for the viewer. Needs Taichi to run.

    Raises TaichiMRFError if no port is free.
    """
    m = create_map(config, frames[0].camera)
    publisher = Publisher("map", m.view.pool, m.seen_by, counting=False)
    server = start_server("127.0.0.1", 0, "bench")
    reader = _Reader(server)
    try:
        prior = m.view.pool.prior_log_odds
        hello = Hello("bench", "", "", config.method, m.voxel_size, prior, config.volume.min_evidence, "")
        scene = MapScene(server, hello)
        up = up_of(frames[0].T_world_camera, frames[0].camera.up)
        reader.settled()
        rows = []
        for done, frame in enumerate(frames, start=1):
            keyframe = m.add(frame)
            m.infer(keyframes=[keyframe], sweeps=1)
            begin = time.perf_counter()
            changes = publisher.changes()
            published = time.perf_counter()
            rows.append(_drawn(scene, changes, up, reader, published - begin))
            advance(done)
        return rows
    finally:
        reader.close()
        server.stop()


def _drawn(
    scene: MapScene, changes: Bricks | None, up: tuple[int, int], reader: "_Reader", publish: float
) -> ViewerRow:
    """Draw one keyframe's changes, and wait until the client has them."""
    before = reader.received
    time.sleep(max(0.0, scene.patience() or 0.0))  # as the page does, which draws 8 times a second at most
    begin = time.perf_counter()
    if changes is not None:
        scene.take(changes)
    scene.flush(ViewOptions(), up, [])
    draw = time.perf_counter() - begin
    reader.settled()
    changed = 0 if changes is None else len(changes.bricks) + len(changes.removed)
    return ViewerRow(publish, draw, changed, reader.received - before, scene.layers["map"].voxels_shown)


class _Reader:
    """A browser that draws nothing: it takes what it is sent, on a thread of its own."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.received = 0
        self._last = time.monotonic()
        self._loop = asyncio.new_event_loop()
        self._problem: BaseException | None = None
        self._connected = threading.Event()
        port = server.get_port()
        self._task = self._loop.create_task(self._read(port))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._connected.wait()
        if self._problem is not None:
            raise TaichiMRFError(f"the viewer's server does not answer: {self._problem}")

    def settled(self) -> None:
        """Wait until nothing more comes."""
        begin = time.monotonic()
        while time.monotonic() < max(begin, self._last) + _QUIET_S:
            time.sleep(0.02)

    def close(self) -> None:
        """Leave."""
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._task)
        except (asyncio.CancelledError, websockets.ConnectionClosed):
            pass
        except OSError as error:
            self._problem = error
        finally:
            self._connected.set()
            self._loop.close()

    async def _read(self, port: int) -> None:
        async with connect(
            f"ws://127.0.0.1:{port}",
            origin=Origin(f"http://127.0.0.1:{port}"),
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None,
            compression=None,
        ) as connection:
            self._connected.set()
            async for message in connection:
                self.received += len(message)
                self._last = time.monotonic()


def measure_viewer(run: BenchRun) -> Measured:
    """Cost of each keyframe to the live view: time on the server and bytes to a browser."""
    rows = [bench_viewer(run.frames, config, advance) for config, advance in run.each_size()]
    sizes = run.options.voxel_sizes
    figures = [
        {"voxel_size": size, "keyframes": [asdict(each) for each in row]}
        for size, row in zip(sizes, rows, strict=True)
    ]
    return [viewer_table(sizes, rows, run.title)], figures, None


def viewer_table(voxel_sizes: Sequence[float], benches: Sequence[Sequence[ViewerRow]], title: str) -> Table:
    """Medians over keyframes, and the largest."""
    table = Table(title=f"Live view: {title}", title_justify="left")
    table.add_column("a keyframe: median (largest)")
    for size in voxel_sizes:
        table.add_column(f"{size * 100:g} cm", justify="right")

    def line(name: str, figure: str, scale: float, digits: int) -> None:
        texts = []
        for rows in benches:
            values = [getattr(row, figure) * scale for row in rows]
            texts.append(f"{statistics.median(values):,.{digits}f} ({max(values):,.{digits}f})")
        table.add_row(name, *texts)

    line("find the changes, ms", "publish", 1e3, 1)
    line("draw them, ms", "draw", 1e3, 1)
    line("changed bricks", "changed", 1, 0)
    line("sent to a browser, MB", "sent", 1e-6, 2)
    table.add_row("voxels shown in the end", *[f"{rows[-1].shown:,}" for rows in benches])
    return table
