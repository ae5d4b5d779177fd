"""What is wrong with a recording, in words and in flags that mend it."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.stereo.pairs import StereoPairs
from taichi_mrf.doctor.mistakes import UNITS, Mistakes
from taichi_mrf.doctor.search import EXPLAINED, Search
from taichi_mrf.doctor.views import Sample, read_sample
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera

_AXES_WORDS = {
    "opengl": "poses are of a camera frame with OpenGL's axes (x right, y up, looking along -z)",
    "ros": "poses are of a frame with a robot's axes (x ahead, y left, z up), not of the optical one",
}
_FEW_MATCHED, _MORE_MATCHED = 0.25, 2.0
_WHOLE_STEP = 0.02


@dataclass(frozen=True)
class Finding:
    """Something to mend, and the flag that mends it; empty if no flag can."""

    text: str
    flag: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """``findings`` are what is odd, ``undecided`` what the recording cannot tell. ``before`` and ``after``
    are the mean differences of frames that see the same, as a share of depth, as recorded and without the
    ``mistakes``; None if no frames see the same."""

    findings: tuple[Finding, ...]
    undecided: tuple[str, ...] = ()
    mistakes: Mistakes = Mistakes()
    before: float | None = None
    after: float | None = None
    search: Search | None = None

    @property
    def flags(self) -> list[str]:
        """The flags of all findings, as they are typed, those of poses in one."""
        poses, _, others = "--poses-are ", None, []
        values = [f.flag.removeprefix(poses) for f in self.findings if f.flag.startswith(poses)]
        others = [word for f in self.findings if f.flag and not f.flag.startswith(poses) for word in f.flag.split()]
        return [*(["--poses-are", ",".join(values)] if values else []), *others]


def diagnose(dataset: Dataset) -> Diagnosis:
    """Look at some twenty frames, and at the poses around them.

    Raises DatasetError if the source cannot be read, has no end, or no poses of its own.
    """
    if dataset.endless or dataset.tracked:
        what = "never ends" if dataset.endless else "has no recorded poses"
        raise DatasetError(f"{dataset.name}: {what}; doctor compares the frames of a recording with poses")
    source = dataset
    while isinstance(getattr(source, "source", None), Dataset):
        source = source.source  # type: ignore[attr-defined]
    swapped = _swapped_images(source)
    if swapped is not None:
        return Diagnosis((swapped,))
    sample = read_sample(dataset)
    steps = getattr(source, "steps_per_metre", None) or _steps(sample)
    search = Search(sample, steps)
    best = search.best()
    before, after = search.score(Mistakes()), search.score(best)
    if not math.isfinite(before):
        return Diagnosis((), ("anything: too few of the frames see the same surfaces",))
    found = _findings(best, steps, source)
    if not found and before > EXPLAINED:
        found.append(
            Finding(f"frames that see the same differ by {before:.1%} of depth; no usual mistake explains it")
        )
    undecided = tuple(search.undecided(best))
    return Diagnosis(tuple(found), undecided, best, before, after, search)


def _findings(mistakes: Mistakes, steps: float, source: Dataset) -> list[Finding]:
    found = []
    if mistakes.w_first:
        found.append(Finding("quaternions are written with w first", "--poses-are wxyz"))
    if mistakes.inverse:
        found.append(Finding("poses take the world to the camera (T_camera_world)", "--poses-are inverse"))
    if mistakes.axes != "optical":
        found.append(Finding(_AXES_WORDS[mistakes.axes], f"--poses-are {mistakes.axes}"))
    if mistakes.late_s:
        late = "late" if mistakes.late_s > 0 else "early"
        text = f"the stamps of the poses are {abs(mistakes.late_s):.2f} s {late}"
        found.append(Finding(text, f"--poses-are late={mistakes.late_s:.2f}"))
    if mistakes.factor != 1:
        right = steps / mistakes.factor
        unit = next(name for each, name in UNITS.items() if math.isclose(each, right))
        text = f"depth has {right:.6g} steps per metre ({unit}), not {steps:.6g}"
        found.append(Finding(text, f"--depth-scale {right:.6g}"))
    if mistakes.along_ray:
        found.append(Finding("depth is measured along the ray, not along the axis", "--depth-is range"))
    if mistakes.lens and isinstance(source.camera, PinholeCamera):
        k = mistakes.camera(source.camera)
        flag = f"--camera {k.fx:.6g},{k.fy:.6g},{k.cx:.6g},{k.cy:.6g}"
        found.append(Finding(f"the intrinsics {mistakes.lens}", flag))
    return found


def _steps(sample: Sample) -> float:
    """The steps per metre that depths are whole numbers of; 1 for depths between steps."""
    depths = [view.points[:, 2] for view in sample.views.values() if isinstance(view.camera, PinholeCamera)]
    values = np.concatenate(depths) if depths else np.empty(0)
    for steps in sorted(UNITS):
        off: NDArray[np.float64] = np.abs(values * steps - np.rint(values * steps))
        if values.size and off.max() < _WHOLE_STEP:
            return steps
    return 1.0


def _swapped_images(source: Dataset) -> Finding | None:
    """Whether far more of a stereo recording's pixels are matched with the left and right images swapped."""
    if not isinstance(source, StereoPairs):
        return None
    swapped = [replace(p, left_file=p.right_file, right_file=p.left_file) for p in source.pairs]
    given, other = _matched(source), _matched(replace(source, pairs=swapped))
    if given > _FEW_MATCHED or other < _MORE_MATCHED * given:
        return None
    return Finding(
        f"the left and right images are swapped: {given:.0%} of the pixels are matched, the other way round "
        f"{other:.0%}; exchange the two folders or topics"
    )


def _matched(pairs: StereoPairs) -> float:
    """The share of pixels with a depth, of the frames at the ends and in the middle."""
    indices = {0, len(pairs) // 2, len(pairs) - 1}
    return float(np.mean([(pairs.read(index).depth_m > 0).mean() for index in indices]))
