"""Diagnosis of a recording: what is odd, in words and in the flags that mend it."""

import math
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import AS_USUAL, AXIAL, POSE_UNITS, RANGE, Conventions
from taichi_mrf.datasets.depth_scale import PLAUSIBLE_MEDIAN_M, out_of_sight
from taichi_mrf.datasets.derived import Derived, Mended, Resampled
from taichi_mrf.datasets.doctor.carried import carried_along
from taichi_mrf.datasets.doctor.readings import UNITS, Reading
from taichi_mrf.datasets.doctor.search import EXPLAINED, FEWEST_PAIRS, QUESTIONS, SEEN_THROUGH, Search
from taichi_mrf.datasets.doctor.views import Sample, read_sample
from taichi_mrf.datasets.pose_sources.posed import PosedFrames
from taichi_mrf.datasets.recorded_noise import note_of_filling
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera, pinhole

_AXES_WORDS = {
    "": "the optical ones: x right, y down, z ahead",
    "opengl": "OpenGL's: x right, y up, z back",
    "ros": "a robot's: x ahead, y left, z up",
    "ned": "an aircraft's: x ahead, y right, z down",
}
_NO_READING = (
    "how it is written: the frames examined see different things, or contradict each other in a "
    "way that none of the usual mistakes explains"
)
_CONTRADICTING = 2 * EXPLAINED
_MOST_EXPLAINED = 0.5
_FEW_MATCHED, _MORE_MATCHED = 0.25, 2.0
_WHOLE_STEP = 0.02
_SMOOTH, _ROUGHER = 0.1, 4.0


@dataclass(frozen=True)
class Finding:
    """Something odd, and the flag that mends it; empty if none does."""

    text: str
    flag: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """``findings`` are what is odd, ``undecided`` what the recording cannot tell. ``before`` and ``after``
    say by how much frames that see the same differ, as a share of depth, as they were read and with the
    ``reading`` that explains them; None where that is not known. ``contradicted``: frames see through what
    others saw, and no reading explains it."""

    findings: tuple[Finding, ...]
    undecided: tuple[str, ...] = ()
    reading: Reading = field(default_factory=Reading)
    before: float | None = None
    after: float | None = None
    search: Search | None = None
    contradicted: bool = False


def unexplained(found: Diagnosis) -> Diagnosis:
    """A diagnosis whose findings do not mend the recording."""
    return Diagnosis((), (_NO_READING,), before=found.before, contradicted=True)


def diagnose(dataset: Dataset, said: Conventions = AS_USUAL) -> Diagnosis:
    """Look at some twenty frames, and at the poses around them. ``said`` are conventions that are said of the
    recording and have not been undone in the dataset. Raises DatasetError if the source cannot be read, has
    no end, or no poses of its own."""
    if dataset.endless or dataset.tracked:
        what = "never ends" if dataset.endless else "has no recorded poses"
        raise DatasetError(
            f"{dataset.name}: {what}; doctor compares the frames of a recording by their poses"
        )
    if isinstance(dataset, Mended):
        said = said if dataset.conventions == AS_USUAL else dataset.conventions
        dataset = as_stored(dataset)
    elif isinstance(dataset, PosedFrames) and dataset.poses.conventions != AS_USUAL:
        inner = dataset.source
        said = dataset.poses.conventions
        if isinstance(inner, Mended):
            undone = inner.conventions
            said = replace(said, along_ray=undone.along_ray, turned=undone.turned)
            inner = as_stored(inner)
        dataset = replace(dataset, source=inner, poses=dataset.poses.as_written(inner.frame_names))
    source: Dataset = dataset
    while isinstance(source, Derived):
        if isinstance(source, Resampled) and source.turned:
            said = replace(said, turned="")  # of the images that are compared
        source = source.source
    given = Reading(**asdict(said))
    swapped = _swapped_images(source)
    if swapped is not None:
        return Diagnosis((swapped,), reading=given)
    sample = read_sample(dataset)
    steps = getattr(source, "steps_per_metre", None) or _steps(sample)
    if _has_swapped_bytes(sample, steps):
        text = (
            "the two bytes of each 16-bit depth are swapped: neighbouring pixels fit the other way round; "
            "write the images again with the bytes exchanged (numpy's byteswap)"
        )
        return Diagnosis((Finding(text),), reading=given)
    search = Search(sample, given, steps)
    best = search.best()
    before = search.score(given)
    off = search.differences(given)
    stands = len(sample.poses) > 0 and np.allclose(sample.poses, sample.poses[0], rtol=0, atol=1e-6)
    if len(off) >= FEWEST_PAIRS and stands and off.mean() > _CONTRADICTING:
        text = f"the poses of {len(sample.poses)} frames are all the same, but what they see is not"
        return Diagnosis((Finding(f"{text}: --poses FILE uses others"),), reading=given)
    carried = _carried(search, best)
    if best == given and before > _CONTRADICTING:
        return _cannot_tell(dataset, search, carried)
    undecided = tuple(search.undecided(best))
    answered = [text for name, text in QUESTIONS.items() if getattr(best, name) != getattr(given, name)]
    likeliest = _with_likeliest_units(best, given, steps, sample)
    nobodys = likeliest.factor != given.factor and not _unit_of_depth(steps / likeliest.factor)
    # Such as depths so large that the camera stands still beside them, and a unit of depth that nobody has.
    if nobodys or set(answered) & set(undecided):
        return _cannot_tell(dataset, search, carried)
    best = likeliest
    found = (*_findings(given, best, steps, source), *carried)
    return Diagnosis(found, undecided, best, before, search.score(best), search)


def _cannot_tell(dataset: Dataset, search: Search, carried: list[Finding]) -> Diagnosis:
    """No reading explains the frames; what no reading mends may be the cause."""
    depths_m = np.concatenate([view.image[view.image > 0] for view in search.sample.views.values()])
    causes = (out_of_sight(dataset), *note_of_filling(depths_m))
    through = search.seen_through(search.given) > SEEN_THROUGH
    findings = (*carried, *(Finding(text) for text in causes if text))
    return Diagnosis(findings, (_NO_READING,), search.given, contradicted=through)


def mistakes(dataset: Dataset) -> list[str]:
    """The findings in words: none for a source that cannot be looked at."""
    try:
        found = diagnose(dataset).findings
    except DatasetError:
        return []
    return [f"{each.text} ({each.flag} mends it)" if each.flag else each.text for each in found]


def doubtful_at_a_glance(dataset: Dataset, seconds: float = 1.0) -> bool:
    """True if a recording, of which nothing is mapped yet, wants a longer look: most of the frames that can
    be read in so many seconds do not explain each other. False if they are too few to tell."""
    if dataset.endless or dataset.tracked:
        return False
    try:
        search = Search(read_sample(dataset, seconds), Reading(), 1.0)
    except DatasetError:
        return False
    off = search.differences(Reading())
    return len(off) >= FEWEST_PAIRS and bool((off <= EXPLAINED).mean() < _MOST_EXPLAINED)


def as_stored(dataset: Dataset) -> Dataset:
    """A dataset without its conventions undone; turned images stay as they are put back if they are
    undistorted too."""
    if isinstance(dataset, PosedFrames):
        return replace(dataset, source=as_stored(dataset.source))
    inner = dataset.source if isinstance(dataset, Mended) else dataset
    return inner.source if isinstance(inner, Resampled) and inner.turned and not inner.distorted else inner


def _carried(search: Search, reading: Reading) -> list[Finding]:
    body = carried_along(search, reading)
    if body is None:
        return []
    v, u = np.nonzero(body)
    text = (
        f"{body.mean():.1%} of the image, in columns {u.min()} to {u.max()} and rows {v.min()} to {v.max()}, "
        "moves with the camera, as a robot's own body does: --mask FILE or --robot arm.urdf leaves it out"
    )
    return [Finding(text)]


def _findings(given: Reading, best: Reading, steps: float, source: Dataset) -> list[Finding]:
    """Differences of the best reading from the given one. Those of poses have the flag of them all."""
    poses = next((flag for flag in best.flags() if flag.startswith("--poses-are")), "--poses-are ''")
    found = []
    if best.w_first != given.w_first:
        found.append(Finding(f"quaternions have w {'first' if best.w_first else 'last'}", poses))
    if best.inverse != given.inverse:
        found.append(Finding(f"poses are {'T_camera_world' if best.inverse else 'T_world_camera'}", poses))
    if best.axes != given.axes:
        found.append(Finding(f"poses are of a frame whose axes are {_AXES_WORDS[best.axes]}", poses))
    if best.late_s != given.late_s:
        late = "late" if best.late_s >= 0 else "early"
        found.append(Finding(f"the stamps of the poses are {abs(best.late_s):.2f} s {late}", poses))
    if best.unit != given.unit:
        name = UNITS[POSE_UNITS[best.unit]] if best.unit else UNITS[1.0]
        found.append(Finding(f"poses are in {name}", poses))
    if best.along_ray != given.along_ray:
        along, word = ("ray", RANGE) if best.along_ray else ("optical axis", AXIAL)
        found.append(Finding(f"depth is measured along the {along}", f"--depth-is {word}"))
    if best.turned != given.turned:
        words = best.turned.replace("-", " ").replace(",", " and ") or "as the sensor took them"
        hands = "; or its poses are left-handed, and then the map is mirrored" if "mirrored" in words else ""
        flag = best.turned or "''"
        found.append(Finding(f"images are {words}{hands}", f"--image-is {flag}"))
    if best.factor != given.factor:
        right = steps / best.factor
        text = f"depth has {right:.6g} steps per metre ({_unit_of_depth(right)}), not {steps:.6g}"
        found.append(Finding(text, f"--depth-scale {right:.6g}"))
    if best.of_camera != given.of_camera and isinstance(source.camera, PinholeCamera):
        k = best.camera_of(source.camera)
        flag = f"--camera {k.fx:.6g},{k.fy:.6g},{k.cx:.6g},{k.cy:.6g}"
        if best.lens:
            found.append(Finding(f"the intrinsics {best.lens}", flag))
        if best.focal != given.focal:
            text = f"the focal length is {best.focal:.2f} times the stated one"
            found.append(Finding(text, flag))
        if best.camera is not None:
            found.append(Finding(_change(source, best.camera), flag))
    return found


def _change(source: Dataset, camera: PinholeCamera) -> str:
    """Sentence that names the first change of intrinsics, where the images show one ``camera`` throughout."""
    first, last = 0, len(source) - 1
    begins = pinhole(source.read(0).camera, "doctor")
    other = begins if begins != camera else pinhole(source.read(last).camera, "doctor")
    while last - first > 1 and other != begins:
        middle = (first + last) // 2
        first, last = (first, middle) if source.read(middle).camera != begins else (middle, last)
    return (
        f"the intrinsics change at frame {source.frame_names[last]}, from fx {begins.fx:g} to {other.fx:g}, "
        f"but what the images show does not: they are of fx {camera.fx:g} throughout"
    )


def _with_likeliest_units(best: Reading, given: Reading, steps: float, sample: Sample) -> Reading:
    """The likeliest of the readings that differ from the best one by the size of the whole world: no
    comparison of frames tells those apart. Surfaces lie where sensors see them, depth has a unit that sensors
    have (none counts whole metres), and little differs from what was given."""
    if best.factor == given.factor and best.unit == given.unit:
        return best
    ratio = best.factor * POSE_UNITS.get(best.unit, 1.0)
    ranges = [np.linalg.norm(view.points, axis=1) for view in sample.views.values()]
    median = float(np.median(np.concatenate(ranges)))
    least, most = PLAUSIBLE_MEDIAN_M
    known = set(UNITS.values()) - {UNITS[1.0]}

    def unlikely(reading: Reading) -> tuple[bool, bool, int]:
        other = reading.factor != 1.0
        return (
            not least <= median * reading.factor <= most,
            other and _unit_of_depth(steps / reading.factor) not in known,
            other + (reading.unit != given.unit),
        )

    units = {"": 1.0, **POSE_UNITS}.items()
    ways = [replace(best, factor=float(np.round(ratio / per_m, 12)), unit=unit) for unit, per_m in units]
    return min(ways, key=unlikely)


def _unit_of_depth(steps: float) -> str:
    """Whose depth has so many steps per metre, empty if nobody's."""
    return next((name for each, name in UNITS.items() if math.isclose(each, steps, rel_tol=1e-6)), "")


def _steps(sample: Sample) -> float:
    """The steps per metre that depths are whole numbers of; 1 for depths between steps."""
    depths = [view.points[:, 2] for view in sample.views.values() if isinstance(view.camera, PinholeCamera)]
    values = np.concatenate(depths) if depths else np.empty(0)
    for steps in sorted(UNITS):
        if values.size and np.abs(values * steps - np.rint(values * steps)).max() < _WHOLE_STEP:
            return steps
    return 1.0


def _has_swapped_bytes(sample: Sample, steps: float) -> bool:
    """True if neighbouring depths, as 16-bit numbers of ``steps`` per metre, differ far more than they do
    with their bytes swapped. Of six clean recordings they differ by .1 to .9% of depth, and at 1000 steps per
    metre by 15 to 50 times as much once swapped."""
    roughness: list[tuple[float, float]] = []
    for view in sample.views.values():
        if not isinstance(view.camera, PinholeCamera):
            continue
        numbers = np.rint(view.image * steps)
        if (
            np.abs(view.image * steps - numbers).max() > _WHOLE_STEP
            or numbers.max() > np.iinfo(np.uint16).max
        ):
            return False
        whole = numbers.astype(np.uint16)
        roughness.append((_roughness(whole), _roughness(whole.byteswap())))
    if not roughness:
        return False
    given, swapped = np.median(roughness, axis=0)
    return bool(swapped < _SMOOTH and given > _ROUGHER * swapped)


def _roughness(numbers: NDArray[np.uint16]) -> float:
    """By how much neighbours in a row differ, as a share of their mean, pixels without a depth aside."""
    left, right = numbers[:, :-1].astype(np.float64), numbers[:, 1:].astype(np.float64)
    both = (left > 0) & (right > 0)
    return float(np.abs(left - right)[both].sum() / max(1.0, left[both].sum()))


def _swapped_images(source: Dataset) -> Finding | None:
    """Finding if far more of a stereo recording's pixels match with the left and right images swapped."""
    from taichi_mrf.datasets.stereo.matching import StereoPairs  # late: few recordings are stereo

    if not isinstance(source, StereoPairs) or not len(source):
        return None
    swapped = [replace(p, left_file=p.right_file, right_file=p.left_file) for p in source.rows]
    given = _matched(source)
    if given > _FEW_MATCHED:
        return None
    other = _matched(replace(source, rows=swapped))
    if other < _MORE_MATCHED * given:
        return None
    return Finding(
        f"the left and right images are swapped: {given:.0%} of the pixels are matched, {other:.0%} the "
        "other way round; exchange them"
    )


def _matched(pairs: Dataset) -> float:
    """The share of pixels with a depth, of the first frame, the last and one between."""
    indices = {0, len(pairs) // 2, len(pairs) - 1}
    return float(np.mean([(pairs.read(index).depth_m > 0).mean() for index in indices]))
