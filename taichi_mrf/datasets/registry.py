"""Sources of frames are opened here: folders and files by the first plug, else the first entry (entries.py)
that recognises them, and the built-in sources by their names.

A plug is a format that another package brings, or one of this package's that few have: an entry point of the
group GROUP that names a Format (base.py). It is asked before the formats of entries.py, so that it can read
what one of those would take. One that cannot be used breaks no other.
"""

import difflib
import re
import warnings
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from taichi_mrf.datasets.base import Dataset, Format
from taichi_mrf.datasets.conventions import AXIAL
from taichi_mrf.datasets.depth_scale import out_of_sight
from taichi_mrf.datasets.derived import mended, pose_of, resampled
from taichi_mrf.datasets.entries import BUILT_IN, FORMATS, ROBOTS
from taichi_mrf.datasets.images import DEPTH_SUFFIXES
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.own_body import NO_BODY, OwnBody
from taichi_mrf.datasets.ros.names import is_bag
from taichi_mrf.datasets.turned import T_sensor_stored, stored_camera
from taichi_mrf.datasets.without_body import masked, without_body
from taichi_mrf.errors import ConfigError, DatasetError, TaichiMRFError, collected_warnings, naming, said
from taichi_mrf.sensor.camera import PinholeCamera, pinhole
from taichi_mrf.system.files import exists, is_folder

if TYPE_CHECKING:
    from taichi_mrf.datasets.ros.bag import BagSummary

GROUP = "taichi_mrf.formats"

OWN = {
    name: f"taichi_mrf.datasets.rare:{name.upper()}"
    for name in ("several_sensors", "stray_scanner", "record3d", "las", "ouster", "rtabmap")
}
"""This package's, as pyproject.toml declares them, for a checkout that is not installed."""


@cache
def plugs() -> tuple[tuple[Format, ...], tuple[str, ...]]:
    """All plugs, this package's first, and a line about each that cannot be used."""
    own = [EntryPoint(name, value, GROUP) for name, value in OWN.items()]
    found = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    others = [point for point in found if OWN.get(point.name) != point.value]
    formats, problems = [plug.load() for plug in own], []
    for point in others:
        try:
            formats.append(_guarded(point.name, point.load()))
        except Exception as error:  # whatever a module of others raises
            problems.append(_problem(point.name, error))
    return tuple(formats), tuple(problems)


def _guarded(plug: str, found: Any) -> Format:
    """A format of others, whose errors name its plug."""
    if not isinstance(found, Format):
        raise TypeError(f"it names {found!r}, which is not a Format")

    def recognises(path: Path) -> bool:
        try:
            return bool(found.recognises(path))
        except Exception as error:
            warnings.warn(_problem(plug, error), stacklevel=2)
            return False

    def open_source(path: Path, *options: Any) -> Dataset:
        try:
            return found.open(path, *options)
        except (TaichiMRFError, OSError):
            raise
        except Exception as error:
            raise DatasetError(f"{path}: {_problem(plug, error)}") from error

    return replace(found, recognises=recognises, open=open_source)


def _problem(plug: str, error: Exception) -> str:
    return f"the plug {plug!r} ({GROUP}) cannot be used: {type(error).__name__}: {said(error)}"


_NOT_ALONE = re.compile(r"(rgb|colou?r|left|right)s?([-_].*)?|.*[-_](rgb|colou?r)|rtabmap_.*", re.IGNORECASE)
"""Folders with a part of a recording, such as its colours."""

_FEW = 5
"""A folder around a recording has fewer things in it, such as a text about it."""


def open_dataset(
    source: str | Path,
    *,
    camera: PinholeCamera | None = None,
    depth_scale: float | None = None,
    color: bool = True,
    max_time_gap: float | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    undistort: tuple[float, ...] | None = None,
    image_scale: float = 1.0,
    track: bool = False,
    poses_are: str | None = None,
    mounting: tuple[float, ...] | None = None,
    depth_is: str = AXIAL,
    image_is: str | None = None,
    body: OwnBody = NO_BODY,
) -> Dataset:
    """Open a recording (a folder or a file) or a built-in source such as ``synthetic:room?frames=60``. The
    keywords are the fields of :class:`ReadOptions`. Warnings of this package become notes. Raises
    DatasetError, which names the source and the formats that were looked for."""
    options = ReadOptions(
        camera, depth_scale, color, max_time_gap, intrinsics, undistort, image_scale, track,
        poses_are, mounting, depth_is, image_is, body,
    )  # fmt: skip
    path = Path(source)
    scheme = re.match(r"([a-z][a-z0-9_]+):", str(source))  # two letters at least: C:\ is a folder
    with collected_warnings() as warned:
        try:
            if scheme and not exists(path):
                dataset = _open_built_in(str(source), options)
            else:
                dataset = _open_path(str(source), options)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error
        dataset = _as_asked(dataset, options)
    dataset.notes = list(dict.fromkeys([*dataset.notes, *(str(warning.message) for warning in warned)]))
    return dataset


def recognise(path: Path) -> Format | None:
    """The format of a folder or a file, or None."""
    return next((each for each in _formats() if each.recognises(path)), None)


def format_name(source: str | Path) -> str:
    """The name of a source's format, for a source that can be opened."""
    path, _ = _path_and_query(str(source))
    if exists(path):
        found = recognise(path) or recognise(_only_inside(path) or path)  # in this order, as it is opened
        return found.name if found is not None else "unknown"
    return str(source).partition("?")[0]


def absolute_source(source: str) -> str:
    """Name of a source for a process that works in another folder."""
    path, query = _path_and_query(source)
    if not exists(path):
        return source
    return f"{path.resolve()}?{query}" if query else str(path.resolve())


def is_rendered(source: str) -> bool:
    """True if Taichi must run before the source's frames can be read."""
    built_in = BUILT_IN.get(source.partition("?")[0])
    return built_in is not None and built_in.rendered


def topics_in(source: str) -> "BagSummary | None":
    """The topics of a bag, or of a robot that runs, which is listened to for some seconds; None for other
    sources. Raises DatasetError."""
    if source.startswith(ROBOTS):
        return resolve_name("taichi_mrf.datasets.wires.robot:summarise")(source)
    path, _ = _path_and_query(source)
    return resolve_name("taichi_mrf.datasets.ros.bag:summarise")(path) if is_bag(path) else None


def _as_asked(dataset: Dataset, options: ReadOptions) -> Dataset:
    """Apply the options that all formats share: the caller's intrinsics, undistortion, every n-th pixel."""
    if options.intrinsics is not None:
        with naming(dataset.name, ConfigError):
            recorded = pinhole(dataset.camera, "--camera")
        dataset.camera = PinholeCamera(recorded.width, recorded.height, *options.intrinsics)
    conventions = options.conventions
    dataset.tracked = dataset.tracked or options.track
    given, turn = dataset.camera, T_sensor_stored(conventions.turned)
    if conventions.turned:  # neighbouring frames are compared as they are stored
        with naming(dataset.name, ConfigError):
            dataset.camera = stored_camera(pinhole(given, "--image-is"), conventions.turned)
    dataset.notes += dataset.check_scale(
        None if dataset.tracked else lambda index: pose_of(dataset.pose(index), conventions) @ turn
    )
    dataset.camera = given
    distortion = dataset.distortion if options.undistort is None else options.undistort
    seen = masked(dataset, options.body.mask)
    picked = resampled(seen, distortion, options.stride, conventions.turned)
    picked.tracked = dataset.tracked
    picked = without_body(picked, options.body, conventions)
    asked = mended(picked, conventions, options.max_time_gap)
    apart = "" if asked.tracked or asked.endless else out_of_sight(asked)
    asked.notes += [f"{apart}; taichi-mrf doctor tells"] if apart else []
    return asked


def _path_and_query(source: str) -> tuple[Path, str]:
    """A path and what follows a question mark in its name, unless that is part of the path."""
    path, mark, query = source.rpartition("?")
    return (Path(path), query) if mark and not exists(Path(source)) else (Path(source), "")


def _open_path(source: str, options: ReadOptions) -> Dataset:
    path, query = _path_and_query(source)
    if not exists(path):
        raise DatasetError(
            f"{path}: no such folder or file, and no built-in source of that name ({', '.join(BUILT_IN)})"
        )
    for problem in plugs()[1]:
        warnings.warn(problem, stacklevel=2)
    found = recognise(path)
    if found is None and (inside := _only_inside(path)) is not None:
        dataset = _open_path(f"{inside}?{query}" if query else str(inside), options)
        dataset.notes.insert(0, f"the recording is {inside}")
        return dataset
    if found is None:
        raise DatasetError(_not_recognised(path))
    if is_folder(path):
        path = path.resolve()
    if found.takes_query:
        return found.open(path, query, options)
    if query:
        raise DatasetError(f"{path}: takes no options after a question mark; bags and built-in sources do")
    return found.open(path, options)


def _not_recognised(path: Path) -> str:
    """Reason why a path cannot be opened, and the remedy."""
    if is_folder(path):
        children = sorted(path.iterdir())
        inside = [child.name for child in _recordings(children)]
        if inside:
            return f"{path}: contains several recordings; pass one of: {', '.join(inside[:8])}"
    hint = resolve_name("taichi_mrf.datasets.hints:hint_for")(path)
    around = None if is_folder(path) else recognise(path.parent)
    if around is not None and (hint is None or path.suffix.lower() in DEPTH_SUFFIXES):
        return f"{path}: is one file of a recording ({around.name}): pass its folder, {path.parent}"
    if hint is not None:
        return f"{path}: {hint}"
    looked_for = "; ".join([*(f"{each.name}: {each.looks_for}" for each in _formats()), *plugs()[1]])
    if not is_folder(path):
        return (
            f"{path}: unsupported file type; for a recording of many files pass its folder. "
            f"Looked for {looked_for}"
        )
    if not children:
        return f"{path}: the folder is empty; looked for {looked_for}"
    return f"{path}: no recording found; looked for {looked_for}"


def _only_inside(path: Path) -> Path | None:
    """The only recording in a folder, as of an archive that was unpacked into a folder of its own name, or in
    the only folder in it; None if there are none or several."""
    if not is_folder(path):
        return None
    children = [child for child in path.iterdir() if not child.name.startswith((".", "__"))]
    inside = _recordings(children)
    folders = [child for child in children if is_folder(child)]
    if inside:
        return inside[0] if len(inside) == 1 else None
    return _only_inside(folders[0]) if len(folders) == 1 and len(children) < _FEW else None


def _formats() -> tuple[Format, ...]:
    """Plug-ins first: they may read recordings that an entry would also recognise."""
    return (*plugs()[0], *FORMATS)


def _recordings(children: list[Path]) -> list[Path]:
    """The recordings among what is in a folder; a folder with a part of one, such as its colours, is none."""
    return [
        child
        for child in children
        if is_bag(child)
        or (is_folder(child) and not _NOT_ALONE.fullmatch(child.name) and recognise(child) is not None)
    ]


def _open_built_in(source: str, options: ReadOptions) -> Dataset:
    name, _, query = source.partition("?")
    kind, _, rest = source.partition(":")
    if f"{kind}:" in BUILT_IN:
        name, query = f"{kind}:", rest
    if name not in BUILT_IN:
        near = difflib.get_close_matches(name, BUILT_IN, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"built-in sources are: {', '.join(BUILT_IN)}"
        raise DatasetError(f"{source}: no such source; {hint}")
    return BUILT_IN[name].open(query, options)
