"""The command that reads a recording as it was written: opened with the flags that were found, and compared
once more, before anybody is told of it."""

import contextlib
import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import AXIAL, conventions_of
from taichi_mrf.datasets.derived import Derived
from taichi_mrf.datasets.doctor.diagnosis import Diagnosis, as_stored, diagnose, unexplained
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError, DatasetError, FrameError

_ROUNDS = 3
"""Rounds of diagnosis at most: each reads with the flags found so far, and looks for further ones."""


@dataclass(frozen=True)
class Remedy:
    """The oddities of a recording; ``command`` reads it as it was written, empty if no command is known."""

    found: Diagnosis
    command: str = ""

    def in_words(self) -> str:
        """The findings and the remedy, in one line."""
        texts = "; ".join(each.text for each in self.found.findings)
        return f"{texts}: {self.command}" if self.command else texts


def remedy(source: str, poses: str | Path | None, reading: SourceFlags) -> Remedy:
    """Look for what is odd in a source, as it is read with these flags and at these poses, and for the
    command that mends it. Raises DatasetError as :func:`diagnose` does."""
    found = _diagnose_as_written(source, poses, reading)
    merged, flags, latest = dict[str, str](), reading, found
    findings = []
    for _ in range(_ROUNDS):
        new = [each for each in latest.findings if each.flag]
        if not new or len(new) < len(latest.findings):
            break
        merged |= {each.flag.split(" ", 1)[0]: each.flag for each in new}
        findings += new
        flags = _with_flags(reading, list(merged.values()))
        try:
            mended = open_posed(source, poses, color=False, **flags.keywords())
            latest = diagnose(mended)
        except (DatasetError, ConfigError):
            return Remedy(unexplained(found))
    if not merged:
        return Remedy(found)
    if latest.findings or latest.before is None or latest.contradicted:
        return Remedy(unexplained(found))
    last = {each.flag.split(" ", 1)[0]: each for each in findings}
    kept = [each for each in findings if each.flag == last[each.flag.split(" ", 1)[0]].flag]
    names = set(merged)
    words = [word for word in reading.words() if word.split("=")[0] not in names]
    words += [f"--poses={poses}"] if poses else []
    command = " ".join(
        [shlex.join(["taichi-mrf", "map", source, *words]), *dict.fromkeys(merged.values()), "--out DIR"]
    )
    return Remedy(replace(found, findings=tuple(kept), after=latest.before), command)


def _diagnose_as_written(source: str, poses: str | Path | None, reading: SourceFlags) -> Diagnosis:
    """Diagnosis of a source with the conventions of the flags not undone, so that they may be found wrong."""
    keywords = reading.keywords()
    words = ("poses_are", "mounting", "depth_is", "image_is")
    said = conventions_of(*(keywords[word] for word in words))
    as_written = {**keywords, **dict.fromkeys(words), "depth_is": AXIAL}
    if said.turned or said.along_ray:  # the sensor's frame, in which boxes are, is not known yet
        as_written["body"] = OwnBody(mask=reading.mask)
    dataset: Dataset
    try:
        dataset = open_posed(source, poses, color=False, **as_written)
    except DatasetError:  # such as scans that are only read with the flag that their poses want
        if as_written == keywords:
            raise
        dataset = open_posed(source, poses, color=False, **keywords)
    if as_written != keywords:
        # An assumed scale of depth may have given way to another at the poses as the flags have them.
        with contextlib.suppress(DatasetError, ConfigError):
            steps = _steps_of(open_posed(source, poses, color=False, **keywords))
            if steps != _steps_of(dataset):
                as_written["depth_scale"] = steps
                dataset = open_posed(source, poses, color=False, **as_written)
    try:
        return diagnose(dataset, said)
    except FrameError as unread:  # such as images whose rows are the columns that the camera states
        try:
            turned = open_posed(source, poses, color=False, **{**as_written, "image_is": "turned-left"})
            return diagnose(as_stored(turned), said)
        except (DatasetError, ConfigError):
            raise unread from None


def _steps_of(dataset: Dataset) -> float | None:
    """Steps of depth per metre; None where no image counts in steps."""
    while isinstance(dataset, Derived):
        dataset = dataset.source
    return getattr(dataset, "steps_per_metre", None)


def _with_flags(reading: SourceFlags, flags: list[str]) -> SourceFlags:
    """The flags of a source with others, as they are typed, in place of some."""
    changed: dict[str, float | str | None] = {}
    for flag in flags:
        name, value = shlex.split(flag)
        field = name.removeprefix("--").replace("-", "_")
        changed[field] = float(value) if field == "depth_scale" else value or None
    return replace(reading, **changed)  # type: ignore[arg-type]
