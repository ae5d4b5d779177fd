"""The messages of a bag's sensor that are mapped, their poses, and their cameras, out of a CameraInfo."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import StampedPoses
from taichi_mrf.datasets.options import DISTORTION_COUNTS, ReadOptions
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.poses import BagPoses, PoseChoice, find_poses
from taichi_mrf.datasets.ros.runs import BagRun, run_of
from taichi_mrf.datasets.ros.sources import Entry, TopicSource
from taichi_mrf.datasets.ros.stamps import stamped
from taichi_mrf.datasets.ros.tf import TransformTree, read_transforms, tree_of
from taichi_mrf.datasets.ros.topics import DepthTopic, choose, choose_depth
from taichi_mrf.datasets.timed_poses import largest_gap, within_gap
from taichi_mrf.datasets.turned import of_image_size, turn_hint
from taichi_mrf.errors import ConfigError, DatasetError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera


@dataclass(frozen=True)
class SensorChoice(PoseChoice):
    """Choice of a sensor's messages and their poses."""

    depth: str = ""
    """The topic of depth images."""

    info: str = ""
    """The topic of their CameraInfo."""

    points: str = ""
    """The topic of a lidar's point clouds, in place of depth images; without depth images by default the only
    one."""

    color: str = ""
    """The topic of colour images, by default the only one."""

    confidence: str = ""
    """The topic of images of confidence, by default the one beside that of depth."""

    imu: str = ""
    """The topic of an IMU whose angular rates help to track the camera (``poses=track``), by default the only
    one; ``none`` for tracking without."""

    deskew: bool = True
    """Undo the lidar's motion during a scan, where points have times."""


@dataclass(frozen=True)
class BagSensor:
    """The messages of a topic, ``what``, that are of one run, by their stamps. ``frame`` is the sensor's, by
    the user's word or the first message; ``tree`` reads its tree of frames."""

    reader: TopicSource
    topic: str
    what: str
    frame: str
    entries: Sequence[Entry]
    run: BagRun
    tree: Callable[[], TransformTree]
    notes: Sequence[str]

    @property
    def frames(self) -> Counter[str]:
        """The frames of the messages, with their numbers: several are those of several sensors."""
        return Counter(entry.frame for entry in self.entries)


def find_sensor(reader: TopicSource, topic: str, what: str, choice: PoseChoice) -> BagSensor:
    """The messages of a topic that are read. Raises DatasetError, naming file and topic, if there is none, or
    no run that the user wants, or if they are of several frames and of none that the user named."""
    recorded, said = stamped(reader, topic, what)
    if not recorded:  # in a damaged file, whose index counts some
        raise DatasetError(f"{reader.path}: topic {topic} contains no message")
    frames = Counter(entry.frame for entry in recorded)
    notes = list(said)
    if choice.optical and len(frames) > 1:
        if choice.optical not in frames:
            raise DatasetError(f"{_several(reader, topic, what, frames)}: ?optical= names none of these")
        recorded = [entry for entry in recorded if entry.frame == choice.optical]
        notes.append(f"of {topic} the {len(recorded)} {what} of {choice.optical} are read")
    run, entries, said = run_of(reader, topic, recorded, choice.run, what)
    frame = choice.optical or entries[0].frame
    return BagSensor(
        reader,
        topic,
        what,
        frame,
        sorted(entries, key=lambda entry: entry.stamp),
        run,
        cache(lambda: _tree(reader, topic, frame, choice.tf, run)),
        notes + said,
    )


def _tree(reader: TopicSource, topic: str, frame: str, tf: str, run: BagRun) -> TransformTree:
    try:
        return tree_of(read_transforms(reader), topic, frame, tf, run)
    except DatasetError as error:
        raise DatasetError(f"{reader.path}: {str(error).removeprefix(f'{reader.path}: ')}") from error


def poses_of(sensor: BagSensor, choice: PoseChoice) -> dict[str, BagPoses]:
    """The poses of a topic's messages by their frames. Raises DatasetError, as find_poses, and if several
    sensors share the topic and one of them has none."""
    frames, found = sensor.frames, {}
    for frame in frames:
        try:
            if len(frames) > 1 and choice.poses:
                raise DatasetError(f"?poses={choice.poses} is for one sensor")
            found[frame] = find_poses(sensor.reader, frame, choice, sensor.tree, sensor.run)
            if len(frames) > 1 and found[frame].registered:
                raise DatasetError(f"the data of {frame} are in the frame of the poses")
        except DatasetError as error:
            said = str(error).removeprefix(f"{sensor.reader.path}: ")
            if len(frames) == 1:
                raise DatasetError(f"{sensor.reader.path}: {said}") from error
            several = _several(sensor.reader, sensor.topic, sensor.what, frames)
            raise DatasetError(f"{several}: ?optical=FRAME reads those of one; {frame}: {said}") from error
    return found


def _several(reader: TopicSource, topic: str, what: str, frames: Mapping[str, int]) -> str:
    words = ", ".join(f"{frame or 'unnamed'} ({count})" for frame, count in frames.items())
    return f"{reader.path}: topic {topic} has {what} of several frames, {words}, as if from several sensors"


Posed = list[tuple[int, Entry, Pose]]
"""Messages with their numbers in the run and their poses."""


def posed_by(
    sensor: BagSensor, found: Mapping[str, BagPoses], options: ReadOptions
) -> tuple[Posed, list[str]]:
    """The messages that have a pose, and notes. Raises DatasetError if none has."""
    gap, entries = largest_gap(options), sensor.entries
    posed, dropped = within_gap(
        [entry.stamp for entry in entries],
        [found[entry.frame].at(entry.stamp, gap) for entry in entries],
        gap,
        f"{sensor.what} of {sensor.topic}",
        str(sensor.reader.path),
        "; ".join(dict.fromkeys(each.source for each in found.values())),
        next((each.stamps for each in found.values() if len(each.stamps)), ()),
    )
    notes = [*sensor.notes, *dict.fromkeys(note for each in found.values() for note in each.notes), *dropped]
    return [(i, entries[i], pose) for i, pose in posed], notes


def track_of(found: Mapping[str, BagPoses], options: ReadOptions) -> Callable[[], StampedPoses] | None:
    """Reads the poses of a topic's only sensor in their own times; None if there are none of these."""
    poses = next(iter(found.values()))
    if len(found) > 1 or not len(poses.stamps):
        return None

    def read() -> StampedPoses:
        known = [(stamp, poses.at(stamp, largest_gap(options))) for stamp in poses.stamps]
        return [stamp for stamp, T in known if T is not None], [T for _, T in known if T is not None]

    return read


class DepthCamera(NamedTuple):
    """The source of a map: a topic of depth images, its messages, the cameras that took them, and their
    poses by the frames of the images."""

    depth: DepthTopic
    sensor: BagSensor
    cameras: "BagCameras"
    poses: dict[str, BagPoses]


def find_depth_camera(reader: TopicSource, choice: SensorChoice, options: ReadOptions) -> DepthCamera:
    """The depth images that are mapped, as the user chose, else the only ones. Raises DatasetError, which
    names the source and lists the candidates."""
    depth = choose_depth(reader, choice.depth)
    sensor = find_sensor(reader, depth.name, "images", choice)
    cameras = find_cameras(sensor, depth, choice.info, options)
    found = poses_of(sensor, choice)
    if any(each.registered for each in found.values()):
        raise DatasetError(
            f"{reader.path}: the images of {depth.name} say that they are in {depth.frame}, the frame that "
            "the poses are in: ?optical=FRAME names the camera's own"
        )
    return DepthCamera(depth, sensor, cameras, found)


_LENS_MODELS = ("plumb_bob", "rational_polynomial", "", "none")

_LOOKED_AT = 5
"""So many images at most are decoded to learn their size."""


@dataclass(frozen=True)
class StatedCamera:
    """A camera that a CameraInfo states: ``full``, and as its region of interest and binning ``cut`` it."""

    full: PinholeCamera
    cut: PinholeCamera

    def of(self, shape: tuple[int, int]) -> PinholeCamera | None:
        """The camera of images (height, width): cut as stated, else full, as of drivers that state the camera
        of the cut images, else one of these scaled alike along both sides. None if none has that size."""
        height, width = shape
        for camera in (self.cut, self.full):
            if camera.shape == shape:
                return camera
        for camera in (self.cut, self.full):
            if camera.width * height == camera.height * width:
                return camera.scaled(width / camera.width)
        return None


@dataclass(frozen=True)
class BagCameras:
    """The cameras by the frame of their images (empty for all), each with the time in seconds from which
    on it took them; the ``first``; the ``distortion`` of all; ``notes`` for the user. They are of the
    CameraInfo of a ``topic``, none if the user gave them, whose frames are ``sent_by`` those of images;
    ``depth`` are the images, and a camera takes them from half a frame, ``early`` seconds, before it is sent.
    """

    by_frame: Mapping[str, list[tuple[float, StatedCamera]]]
    first: PinholeCamera
    distortion: tuple[float, ...] = ()
    notes: list[str] = field(default_factory=list)
    topic: str = ""
    sent_by: Mapping[str, str] = field(default_factory=dict)
    rectified: bool = False
    early: float = 0.0
    stored: Callable[[StatedCamera], StatedCamera] = lambda camera: camera
    """A camera that is stated as that of stored images, which may be turned."""

    def hear(self, entry: Entry, message: Any) -> tuple[float, str]:
        """Take a CameraInfo of a robot that runs, and return from when on it counts, with what to say if it
        changes a camera, else an empty text. A lens that is distorted stays what it was at first."""
        try:
            camera, distortion = camera_of(message, self.rectified)
            camera = self.stored(camera)
        except DatasetError:  # of a driver that starts again
            return entry.stamp, ""
        since, said = entry.stamp - self.early, ""
        for stated in (self.by_frame[frame] for frame, of in self.sent_by.items() if of == entry.frame):
            old = stated[-1][1]
            if distortion != self.distortion or (distortion and camera != old):
                said = "and the lens is distorted: the previous one is kept"
            elif camera != old:
                stated.append((since, camera))
                said = f"fx is {camera.full.fx:g}, before {old.full.fx:g}"
        return since, said

    def begin_again(self) -> None:
        """Take the last cameras from any time on: the clock has started again."""
        for stated in self.by_frame.values():
            stated[:] = [(-np.inf, stated[-1][1])]

    def at(self, entry: Entry, shape: tuple[int, int] | None = None) -> PinholeCamera:
        """The camera that took an image, of the size that was stated if none has the image's."""
        stated = self.by_frame.get(entry.frame) or self.by_frame[""]
        begin = [since for since, _ in stated]
        camera = stated[max(0, bisect_right(begin, entry.stamp) - 1)][1]
        return (camera.of(shape) if shape is not None else None) or camera.cut

    def of_images(self, size: tuple[int, int], turned: str) -> "BagCameras":
        """The cameras of stored images of this (width, height), which are ``turned``."""

        def of(camera: StatedCamera) -> StatedCamera:
            return StatedCamera(*(of_image_size(each, size, turned) for each in (camera.full, camera.cut)))

        stated = {frame: [(s, of(each)) for s, each in found] for frame, found in self.by_frame.items()}
        return replace(self, by_frame=stated, first=of_image_size(self.first, size, turned), stored=of)

    def measured(
        self, message: Any, entry: Entry, depth_scale: float | None, where: str
    ) -> tuple[NDArray[np.float32], PinholeCamera]:
        """The depths (H, W) of an image in metres, and the camera that took it. Raises DatasetError, which
        begins with ``where``, if it is no depth or not of its camera's size."""
        with naming(where):
            depth_m = messages.depth_image(message, depth_scale)
        camera = self.at(entry, depth_m.shape)
        if depth_m.shape != camera.shape:
            raise DatasetError(
                f"{where}: the image has {depth_m.shape[1]} x {depth_m.shape[0]} pixels, "
                f"the camera {camera.width} x {camera.height}"
            )
        return depth_m, camera


def find_cameras(sensor: BagSensor, depth: DepthTopic, wanted: str, options: ReadOptions) -> BagCameras:
    """The cameras of a topic's images, given by the user or by CameraInfo on the topic ``wanted`` or the only
    one that fits. Raises DatasetError, which names file, topic and remedy, if none is known or fits."""
    reader, entries, given = sensor.reader, sensor.entries, options.camera
    if options.intrinsics is not None and given is None:
        with naming(f"{reader.path}: topic {depth.name}"):
            height, width = messages.depth_image(reader.first(depth.name), None).shape
        given = PinholeCamera(width, height, *options.intrinsics)
    if given is not None:
        return BagCameras({"": [(0.0, StatedCamera(given, given))]}, given)
    if not (wanted or depth.info):
        raise DatasetError(f"{reader.path}: contains no CameraInfo; pass --camera fx,fy,cx,cy")
    name = choose(reader, "info", wanted, depth.info, f"topics of the CameraInfo of {depth.name}")
    if reader.first(name) is None or reader.topics[name].type != messages.CAMERA_INFO:
        raise DatasetError(f"{reader.path}: topic {name} contains no {messages.CAMERA_INFO}")
    stated: dict[str, list[tuple[float, StatedCamera, tuple[float, ...]]]] = {}
    problems: dict[str, str] = {}  # a driver that warms up may send zeros first
    early = _half_a_frame(entries)
    sent = dict(reader.messages(name))
    for entry in sensor.run.of(list(sent)) or sent:
        message = sent[entry]
        try:
            camera, distortion = camera_of(message, depth.rectified)
        except DatasetError as error:
            problems.setdefault(entry.frame, str(error))
            continue
        found = stated.setdefault(entry.frame, [])
        if not found or found[-1][1:] != (camera, distortion):
            found.append((entry.stamp - early, camera, distortion))
    frames = dict.fromkeys(entry.frame for entry in entries)
    by_frame, lenses, sent_by = {}, [], {}
    for frame in frames:
        of = _frame_of_info(reader, depth, name, frame, [*stated, *problems], bool(wanted), len(frames) > 1)
        sent_by[frame] = of
        if of not in stated:
            raise DatasetError(f"{reader.path}: topic {name}: {problems[of]}")
        found = stated[of]
        if len(found) > 1 and any(distortion for _, _, distortion in found):
            raise DatasetError(
                f"{reader.path}: topic {name}: the camera changes at {found[1][0] + early:.3f} s and its "
                "lens is distorted; --camera fx,fy,cx,cy takes one for all images, with --undistort"
            )
        by_frame[frame] = [(since, camera) for since, camera, _ in found]
        lenses.append(found[0][2])
    if len(set(lenses)) > 1:
        raise DatasetError(
            f"{reader.path}: topic {name}: the cameras of {', '.join(frames)} have different lenses; "
            "?optical=FRAME takes one's images only"
        )
    cameras = BagCameras(
        by_frame,
        by_frame[entries[0].frame][0][1].cut,
        lenses[0],
        _changes(by_frame, entries),
        name,
        sent_by,
        depth.rectified,
        early,
    )
    return _fitted(reader, depth, name, entries, cameras, options.conventions.turned)


def _frame_of_info(
    reader: TopicSource,
    depth: DepthTopic,
    name: str,
    frame: str,
    known: list[str],
    wanted: bool,
    several: bool,
) -> str:
    """The frame of the CameraInfo of images in a frame. Raises DatasetError if there is none."""
    if frame in known:
        return frame
    if not several and (wanted or not frame or "" in known):
        return "" if "" in known else known[0]
    raise DatasetError(
        f"{reader.path}: the images of {depth.name} are of the frame {frame}, but the CameraInfo "
        f"of {name} is of {', '.join(dict.fromkeys(known))}, maybe another camera's; "
        "pass --camera fx,fy,cx,cy" + ("" if several else f", or ?info={name} to use it anyway")
    )


def _changes(
    by_frame: Mapping[str, Sequence[tuple[float, StatedCamera]]], entries: Sequence[Entry]
) -> list[str]:
    """A note of cameras that change, with the number of the first image of another one."""
    frame, stated = max(by_frame.items(), key=lambda each: len(each[1]))
    if len(stated) == 1:
        return []
    times = "once" if len(stated) == 2 else f"{len(stated) - 1} times"
    (_, old), (since, new) = stated[:2]
    first = next((i for i, e in enumerate(entries) if e.stamp >= since and e.frame == frame), None)
    which = f"from frame {first:06d} on " if first is not None else ""
    return [
        f"the camera changes {times}, according to its CameraInfo: {which}fx is {new.full.fx:g}, "
        f"before {old.full.fx:g}"
    ]


def _half_a_frame(entries: Sequence[Entry]) -> float:
    """Half the usual time between images in seconds: a CameraInfo may be that much later than its image."""
    gaps = np.diff(np.unique([entry.stamp for entry in entries]))
    return 0.5 * float(np.median(gaps)) if len(gaps) else 0.0


def _fitted(
    reader: TopicSource,
    depth: DepthTopic,
    name: str,
    entries: Sequence[Entry],
    cameras: BagCameras,
    turned: str,
) -> BagCameras:
    """The cameras with the first one as it fits its images, which may be ``turned``, and a note if they
    have another size than its CameraInfo. Raises DatasetError if none of the first images fits."""
    problem = ""
    for entry in entries[:_LOOKED_AT]:
        try:
            height, width = shape = messages.depth_image(reader.read(depth.name, entry), None).shape
        except DatasetError:
            continue
        hint = turn_hint(cameras.at(entry), (width, height))
        cameras = cameras.of_images((width, height), turned)
        stated, camera = cameras.at(entry), cameras.at(entry, shape)
        sizes = f"{width} x {height} pixels, the CameraInfo of {name} {stated.width} x {stated.height}"
        if camera.shape == shape:
            scaled = f"the images of {depth.name} have {sizes}: the camera is fitted to them"
            notes = [scaled] if stated.shape != shape else []
            return replace(cameras, first=camera, notes=cameras.notes + notes)
        problem = problem or f"{sizes}, which is not the same view; pass --camera fx,fy,cx,cy{hint}"
    if problem:
        raise DatasetError(f"{reader.path}: the images of {depth.name} have {problem}")
    return cameras


def camera_of(info: Any, rectified: bool) -> tuple[StatedCamera, tuple[float, ...]]:
    """The camera of a CameraInfo and its OpenCV distortion coefficients, () if it has none. Images that are
    ``rectified`` are those of the projection P, and have no distortion left. Raises DatasetError, which does
    not name the topic, if it is not calibrated, or has a lens model that is not OpenCV's."""
    K, D, P = (_field(info, name) for name in "kdp")
    matrix, projection = K.reshape(3, 3), P.reshape(3, 4)[:, :3]
    # Drivers without a calibration leave K at zero or the identity, and some of them fill P alone.
    rectified = rectified or matrix[0, 0] <= 1 < projection[0, 0]
    if rectified and P.any():
        matrix = projection
    if matrix[0, 0] <= 1:
        raise DatasetError(
            f"is not calibrated (a focal length of {matrix[0, 0]:g} pixels); pass --camera fx,fy,cx,cy"
        )
    if not (info.width and info.height):
        k = ",".join(f"{matrix[i, j]:g}" for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        raise DatasetError(
            f"says that images have {info.width} x {info.height} pixels, so nothing tells whether its "
            f"intrinsics are theirs; --camera {k} takes them"
        )
    with naming("", ConfigError):
        full = PinholeCamera.from_matrix(int(info.width), int(info.height), matrix)
        camera = StatedCamera(full, _cut(full, info))
    if rectified or not D.any():
        return camera, ()
    if info.distortion_model not in _LENS_MODELS or len(D) not in DISTORTION_COUNTS:
        raise DatasetError(
            f"distortion model {info.distortion_model!r} with {len(D)} coefficients is not supported; "
            "--undistort 0,0,0,0 uses the images as they are"
        )
    return camera, tuple(float(k) for k in D)


def _cut(camera: PinholeCamera, info: Any) -> PinholeCamera:
    """The camera of the pixels that are left by the region of interest, in pixels of the full image, and then
    by binning; 0 stands for the whole and for none (sensor_msgs/CameraInfo)."""
    roi, bins = info.roi, (max(1, int(info.binning_x)), max(1, int(info.binning_y)))
    width, height = int(roi.width) or camera.width, int(roi.height) or camera.height
    x, y = (int(roi.x_offset), int(roi.y_offset)) if roi.width and roi.height else (0, 0)
    if (width, height, x, y, *bins) == (camera.width, camera.height, 0, 0, 1, 1):
        return camera
    return PinholeCamera(
        width // bins[0],
        height // bins[1],
        camera.fx / bins[0],
        camera.fy / bins[1],
        (camera.cx - x) / bins[0],
        (camera.cy - y) / bins[1],
    )


def _field(message: Any, name: str) -> NDArray[np.float64]:
    """An array of a CameraInfo, whose names ROS 1 writes in capitals."""
    values = getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
    return np.asarray(values, np.float64)
