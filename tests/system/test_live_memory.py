"""The memory of a live run, for half an hour."""

import statistics
import threading
import time
from pathlib import Path

import pytest
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
