"""Stamps of a topic's messages that are 0, repeated or far off, beside others that are right."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.messages import header_ns
from taichi_mrf.datasets.ros.sources import NANOSECONDS, Entry, TopicSource
from taichi_mrf.datasets.trajectories import RESTART_S

_NEAR = 5
"""Messages around one whose delays tell what its own was."""

_LEAST = 3
_LOOKED_AT = 100
_LONGEST_DELAY_S = 1.0


def mended_stamps(
    recorded_s: Sequence[float], stamps_s: Sequence[float], repeated: Sequence[bool] = ()
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Stamps (N,) of messages in the order of recording, and which of them were wrong, (N,): 0, ``repeated``
    long after, or out of the order of their neighbours by more than a clock's restart. In place of a wrong
    one is the time of recording, less the usual delay of the messages around it; NaN where that varies by
    more than half the time between two messages. None is wrong where nearly all are 0."""
    recorded, s = np.asarray(recorded_s, np.float64), np.asarray(stamps_s, np.float64)
    wrong = s == 0
    good = np.flatnonzero(~wrong)
    if len(good) < _LEAST:
        return np.where(wrong, recorded, s), np.zeros(len(s), dtype=np.bool_)
    gap_s = float(np.median(np.abs(np.diff(s[good]))))
    delay = recorded - s
    usual = np.array([np.median(delay[good[_around(k, len(good))]]) for k in range(len(good))])
    before, after = np.r_[-np.inf, s[good][:-1]], np.r_[s[good][1:], np.inf]
    off = np.abs(delay[good] - usual)
    wrong[good] = ((s[good] < before) | (s[good] > after)) & (off > RESTART_S)
    if len(repeated):
        wrong[good] |= np.asarray(repeated)[good] & (off > 0.5 * gap_s)
    found, good = s.copy(), np.flatnonzero(~wrong)
    for i in np.flatnonzero(wrong):
        near = delay[good[_around(int(np.searchsorted(good, i)), len(good))]]
        found[i] = recorded[i] - np.median(near) if np.ptp(near) <= 0.5 * gap_s else np.nan
    return found, wrong


def _around(place: int, count: int) -> slice:
    """The _NEAR numbers around one, fewer at the ends."""
    return slice(max(0, place - _NEAR // 2), min(count, place + _NEAR // 2 + 1))


def stamped(reader: TopicSource, topic: str, what: str) -> tuple[list[Entry], list[str]]:
    """The messages of a sensor's topic with stamps that are right, and notes of those that were not. Data
    that are sent again with their stamp keep it."""
    entries: list[Entry] = []
    zero, repeated, last = [], [], dict[str, tuple[float, Any]]()
    for entry, message in reader.messages(topic):
        entries.append(entry)
        zero.append(header_ns(message.header) == 0)
        stamp, data = last.get(entry.frame, (np.nan, None))
        repeated.append(stamp == entry.stamp and not np.array_equal(data, message.data))
        last[entry.frame] = entry.stamp, message.data
    if not entries:
        return [], []
    if len(entries) > 2 and 2 * len({(entry.frame, entry.stamp) for entry in entries}) < len(entries):
        said = f"the stamps of {topic} do not change: the times of recording are used"
        return [replace(entry, stamp=entry.recorded_ns / NANOSECONDS) for entry in entries], [said]
    if sum(zero) > len(zero) - _LEAST and zero[0]:
        source, delay_s = _delay(reader, topic)
        said = f"the stamps of {topic} are 0: the times of recording are used, "
        said += f"less the {delay_s:.3f} s of {source}" if source else "which are later"
        return [
            replace(entry, stamp=entry.recorded_ns / NANOSECONDS - delay_s) if unknown else entry
            for entry, unknown in zip(entries, zero, strict=True)
        ], [said]
    given = [0.0 if unknown else entry.stamp for entry, unknown in zip(entries, zero, strict=True)]
    found, wrong = mended_stamps([entry.recorded_ns / NANOSECONDS for entry in entries], given, repeated)
    left_out = np.isnan(found)
    notes = []
    if taken := int((wrong & ~left_out).sum()):
        right = [entry for entry, each in zip(entries, wrong, strict=True) if not each]
        delays = [entry.recorded_ns / NANOSECONDS - entry.stamp for entry in right]
        notes = [
            f"{taken} of {len(entries)} {what} of {topic} have a stamp that is 0, repeated or far off: their "
            f"times of recording are used, less the usual {np.median(delays):.3f} s"
        ]
    if left_out.any():
        notes.append(
            f"{left_out.sum()} of {len(entries)} {what} of {topic} left out: their stamps are 0, repeated or "
            "far off, and the others are recorded with delays that vary too much to tell"
        )
    kept = zip(entries, found.tolist(), left_out.tolist(), strict=True)
    return [replace(entry, stamp=stamp) for entry, stamp, out in kept if not out], notes


def _delay(reader: TopicSource, topic: str) -> tuple[str, float]:
    """The topic that tells the delay, CameraInfo beside ``topic``, tf or poses, and the delay from a stamp to
    the recording of its message in seconds; "" and 0 if none does."""
    beside = topic.rpartition("/")[0]
    types = {messages.CAMERA_INFO: 0, **dict.fromkeys(messages.TF, 1), **dict.fromkeys(messages.POSES, 2)}
    others = [
        each
        for each in reader.topics.values()
        if each.type in types
        and not each.name.endswith("tf_static")
        and (each.type != messages.CAMERA_INFO or each.name.rpartition("/")[0] == beside)
    ]
    for each in sorted(others, key=lambda each: types[each.type]):
        delays = []
        for entry, message in islice(reader.messages(each.name), _LOOKED_AT):
            headers = [part.header for part in getattr(message, "transforms", [message])]
            delays += [(entry.recorded_ns - header_ns(h)) / NANOSECONDS for h in headers if header_ns(h)]
        if len(delays) >= _LEAST and 0 <= (delay_s := float(np.median(delays))) < _LONGEST_DELAY_S:
            return each.name, delay_s
    return "", 0.0
