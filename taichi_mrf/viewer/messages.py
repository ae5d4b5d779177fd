"""What the mapping process and the viewer's process tell each other.

The two share nothing: whoever maps owns Taichi and the map, whoever shows owns the page and a copy of
what it was told. Everything here is plain data that can be pickled. Updates go one way, requests the
other, and neither side waits for an answer.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

LOG_ODDS_STEP = 1 / 512
"""Log-odds travel as int16 multiples of this, rounded down, so that their sign, and with it the threshold
of one half, is exact; beyond +-64 they are cut off."""

Layer = Literal["map", "beside"]
"""The map itself, or OctoMap's way with the same frames, shown beside it."""

KeyframeState = Literal["on", "off", "frozen"]


def pack_log_odds(log_odds: NDArray[np.float32]) -> NDArray[np.int16]:
    """Log-odds as they travel."""
    steps = np.floor(log_odds * (1 / LOG_ODDS_STEP))
    return np.clip(steps, -32768, 32767, out=steps).astype(np.int16)


class Update:
    """Base of what the mapping process tells its viewer; the tuning page adds its own."""


class Request:
    """Base of what a viewer asks of the mapping process; the tuning page adds its own."""


@dataclass(frozen=True)
class Hello(Update):
    """The first update, and again after a reset: what is mapped, and with which parameters."""

    source: str
    backend: str
    device: str
    method: str
    voxel_size: float
    prior_log_odds: float
    min_evidence: float
    parameters: str
    """The effective configuration as YAML."""


@dataclass(frozen=True)
class Bricks(Update):
    """Bricks whose voxels may have changed, and bricks that are gone.

    ``bricks`` (n, 3) int32 brick coordinates; ``log_odds`` (n, 512) int16, see :data:`LOG_ODDS_STEP`;
    ``seen`` (n, 512) uint8, how many keyframes' rays went through each voxel (255: so many or more);
    ``removed`` (m, 3) int32.
    """

    layer: Layer
    bricks: NDArray[np.int32]
    log_odds: NDArray[np.int16]
    seen: NDArray[np.uint8]
    removed: NDArray[np.int32]


@dataclass(frozen=True)
class KeyframeInfo(Update):
    """A keyframe that is new or has changed.

    ``picture`` is the depth image in colours, (h, w, 3) uint8 and small; ``crossed`` (n, 3) int32 are the
    bricks that its rays go through, which are known to be free where the map has no voxels. ``T_home`` is
    where *Put back* puts it; None means where the first message of it said.
    """

    id: int
    name: str
    T_world_camera: Pose
    camera: PinholeCamera
    rays: int
    state: KeyframeState
    picture: NDArray[np.uint8]
    crossed: NDArray[np.int32]
    T_home: Pose | None = None


@dataclass(frozen=True)
class CurrentCamera(Update):
    """Where the frame that was read last was taken, keyframe or not."""

    name: str
    T_world_camera: Pose
    camera: PinholeCamera


@dataclass(frozen=True)
class Status(Update):
    """How the work stands. ``activity`` says in words what the worker is doing, ``share`` how much of that
    is done (0 to 1), ``pending`` whether edits have not reached the map yet, ``speed`` the multiple of the
    recording's pace (0: as fast as it goes)."""

    activity: str
    share: float
    frame: int
    frames: int
    keyframes: int
    frozen: int
    keyframes_per_second: float
    voxels: int
    bricks: int
    memory_mb: float
    paused: bool
    finished: bool
    pending: bool
    speed: float = 0.0


@dataclass(frozen=True)
class Notice(Update):
    """Something that the user should know, in one sentence."""

    text: str
    severity: Literal["info", "warning", "error"] = "info"


@dataclass(frozen=True)
class RayAnswer(Update):
    """What a ray meets, all (n,) by range in metres; see queries.profile.RayProfile.

    ``measured_m`` is the range that the keyframe measured there, None without a measurement; ``bias_m``
    and ``sigma_m`` are what the sensor's noise is there, along the ray.
    """

    title: str
    origin: tuple[float, float, float]
    direction: tuple[float, float, float]
    distance: NDArray[np.float32]
    length: NDArray[np.float32]
    occupancy: NDArray[np.float32]
    visibility: NDArray[np.float32]
    omega: NDArray[np.float32]
    measured_m: float | None
    bias_m: float
    sigma_m: float
    keyframe: int | None = None
    """The keyframe whose pixel's ray this is, None for a ray from the viewpoint."""
    pixel: tuple[int, int] | None = None
    """Column and row of that pixel."""


@dataclass(frozen=True)
class Images(Update):
    """Pictures of one view, (h, w, 3) uint8 each; ``score`` is the sentence below them."""

    title: str
    measured: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    accuracy: NDArray[np.uint8]
    score: str


@dataclass(frozen=True)
class File(Update):
    """A file for the browser of the client that asked."""

    name: str
    content: bytes
    client: int


@dataclass(frozen=True)
class Listening(Request):
    """The viewer's first word: where its page is. ``port`` may not be the one that was asked for."""

    host: str
    port: int


@dataclass(frozen=True)
class Pause(Request):
    """Pause the replay, or go on."""

    on: bool


@dataclass(frozen=True)
class Step(Request):
    """Take one more keyframe, then pause."""


@dataclass(frozen=True)
class Speed(Request):
    """Replay at this multiple of the recording's own pace; 0 is as fast as it goes."""

    factor: float


@dataclass(frozen=True)
class Reset(Request):
    """Forget the map and begin the source anew."""


@dataclass(frozen=True)
class Switch(Request):
    """Take a keyframe out of the map, or bring it back."""

    keyframe: int
    on: bool


@dataclass(frozen=True)
class Freeze(Request):
    """Fold a keyframe into the map for good."""

    keyframe: int


@dataclass(frozen=True)
class Move(Request):
    """Give a keyframe another pose."""

    keyframe: int
    T_world_camera: Pose


@dataclass(frozen=True)
class RayThrough(Request):
    """Show the ray of a camera through a point, (x, y, z) in metres; of ``keyframe`` if that sees the point,
    else of one that does, else of the eye."""

    point: tuple[float, float, float]
    eye: tuple[float, float, float]
    keyframe: int | None


@dataclass(frozen=True)
class PixelRay(Request):
    """Show the ray of a keyframe's pixel; ``u`` and ``v`` in pixels, (0, 0) is the first one's centre."""

    keyframe: int
    u: float
    v: float


@dataclass(frozen=True)
class Watch(Request):
    """Which extras to keep up to date: images of ``view`` (a keyframe, or None for the current camera),
    OctoMap's way beside the map, and the ``counts`` of keyframes that see each voxel (else told as 0)."""

    images: bool
    view: int | None
    beside: bool
    counts: bool = False


@dataclass(frozen=True)
class Save(Request):
    """Make a file for a client, and put it in the run's folder if it has one."""

    kind: Literal["map", "ply"]
    client: int


@dataclass(frozen=True)
class Quit(Request):
    """The viewer has ended or must end."""
