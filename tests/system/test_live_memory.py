"""A live run for a long time: its memory, and what a browser has to draw."""

import statistics
import threading
import time
from pathlib import Path

import browser
import pytest
from browser import LivePage, chromium
from live_program import LiveProgram
from raw_viewer_client import RawClient, camera_message, raw_client
from websockets.exceptions import ConnectionClosed

MINUTES, WARM_UP_MINUTES, SAMPLES_A_MINUTE = 30, 5, 6
MOST_DEVIATION = 0.05


def memory_mb(pid: int) -> float:
    """Resident memory of a process, MB. Its proportional share (PSS) would move whenever another program
    that uses the same libraries comes or goes."""
    (line,) = (x for x in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines() if x.startswith("Rss:"))
    return int(line.split()[1]) / 1024


def take_all(client: RawClient, lost: list[str]) -> None:
    """Read and forget what the viewer sends, until the connection ends."""
    client.say(camera_message())
    try:
        for _ in client.connection:
            pass
        lost.append("the viewer has closed the connection")
    except (OSError, ConnectionClosed) as error:
        lost.append(str(error))


@pytest.mark.soak
def test_the_memory_of_a_live_run_is_flat() -> None:
    """Of both processes, with keyframes that are frozen as they age. Medians of minutes are compared, since a
    single sample may fall into a moment in which some temporary array lives."""
    lost: list[str] = []
    with LiveProgram("synthetic:room", "--loop", "--keep-live", "24") as program:
        viewer = next(pid for pid, command in program.group().items() if "spawn_main" in command)
        samples: dict[int, list[float]] = {program.pid: [], viewer: []}
        with raw_client(program.port) as client:
            threading.Thread(target=take_all, args=(client, lost), daemon=True).start()
            for _ in range(MINUTES * SAMPLES_A_MINUTE):
                time.sleep(60 / SAMPLES_A_MINUTE)
                assert not lost, program.said
                for pid, values in samples.items():
                    values.append(memory_mb(pid))
    for values in samples.values():
        minutes = [values[i : i + SAMPLES_A_MINUTE] for i in range(0, len(values), SAMPLES_A_MINUTE)]
        first, *later = map(statistics.median, minutes[WARM_UP_MINUTES:])
        assert later == pytest.approx([first] * len(later), rel=MOST_DEVIATION)


@pytest.mark.soak
@pytest.mark.shared_data
@pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))
def test_ten_minutes_with_a_browser_change_nothing(shared_data: Path) -> None:
    """The kitchen again and again: memory of the processes and of the page, nodes of its scene, and the time
    from a press of a button until the view has turned. Its first minutes are compared with its last ones."""
    flags = ("--loop", "--keep-live", "24", "--runtime.arch", "cpu")
    rows: list[dict[str, float]] = []
    with LiveProgram(shared_data / "seven_scenes_redkitchen", *flags) as program, chromium() as opened:
        page = LivePage(opened, program.address)
        viewer = next(pid for pid, command in program.group().items() if "spawn_main" in command)
        page.until(lambda seen: len(seen.keyframes) >= 24, "24 keyframes")
        begin = time.monotonic()
        while (minute := (time.monotonic() - begin) / 60) < 10:
            page.pause(20)
            page.press("Top")
            page.pause(3)
            eye, pressed = page.position(), time.monotonic()
            page.press("Front")
            page.until(lambda seen: page.position() != eye, "a view that has turned")  # noqa: B023
            row = {"minute": minute, "lag_s": time.monotonic() - pressed, "nodes": len(page.look().nodes)}
            row |= {"mapper_mb": memory_mb(program.pid), "viewer_mb": memory_mb(viewer)}
            heap = page.page.evaluate("() => performance.memory.usedJSHeapSize")
            rows.append(row | {"page_mb": heap / 2**20})
            print(rows[-1], flush=True)
        assert page.problems == []
    first = [row for row in rows if 2 <= row["minute"] < 5]
    last = [row for row in rows if row["minute"] >= 7]
    for name in ("nodes", "mapper_mb", "viewer_mb", "page_mb", "lag_s"):
        medians = [statistics.median(row[name] for row in part) for part in (first, last)]
        assert medians[1] < 1.1 * medians[0] + (0.1 if name == "lag_s" else 0), (name, rows)
