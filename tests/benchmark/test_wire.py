"""What the measurement of a live run over a wire says of its events, made by hand."""

from pathlib import Path

import pytest

from benchmarks.lab.wire import _taken


def test_a_lag_ends_when_all_that_a_keyframe_changed_is_sent(tmp_path: Path) -> None:
    """The second image's changes are put in two parts, the first of which is sent alone; the third changes
    nothing that is shown, and what is put after it belongs to no image."""
    events = tmp_path / "events"
    events.write_text(
        "taken 10.0 10.1 0\nput 10.3\nshown 10.31\nsent 10.32 10.35\n"
        "taken 11.0 11.2 2\nput 11.3\nsent 11.31 11.32\nput 11.4\nshown 11.41\nsent 11.45 11.5\n"
        "taken 12.0 12.1 3\nshown 12.2\nput 12.3\nsent 12.31 12.4\n"
        "take"  # a line that is still being written
    )
    numbers, lags_s = _taken(events)
    assert numbers == [0, 2, 3]
    assert lags_s == pytest.approx([0.35, 0.5])
