"""Messages between the mapping process and the viewer's process.

The two share no memory: the mapping process owns Taichi and the map, the viewer's process owns the page and a
copy of what was published. Messages are plain data that can be pickled. Updates go to the viewer, requests
come from it, and neither side waits for an answer.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.voxels.layers import COLORS

LOG_ODDS_STEP = 1 / 512
"""Log-odds are sent as int16 multiples of this. They are rounded down, so that their sign, and with it the
threshold of one half, is exact; beyond +-64 they are clipped."""

BEAT_S = 1.0
"""The mapping process sends Alive when it has sent nothing else for so long."""

Layer = Literal["map", "baseline", "dynamic"]
"""The map itself; the baseline beside it, OctoMap's log-odds update of the same keyframes; and of the map the
bricks with dynamic voxels, those whose log-odds are not below 0."""

KeyframeState = Literal["on", "off", "frozen"]


def pack_log_odds(log_odds: NDArray[np.float32]) -> NDArray[np.int16]:
    """Log-odds (any shape) as they are sent."""
    steps = np.floor(log_odds * (1 / LOG_ODDS_STEP))
    return np.clip(steps, -32768, 32767, out=steps).astype(np.int16)


class Update:
    """Base of what the mapping process tells its viewer; the tuning page adds its own."""


class Request:
    """Base of what a viewer asks of the mapping process; the tuning page adds its own."""


@dataclass(frozen=True)
class Hello(Update):
    """The first update, and the first after a reset: the source, the backend and the parameters."""

    source: str
    backend: str
    device: str
    method: str
    voxel_size: float
    prior_log_odds: float
    min_evidence: float
    parameters: str
    """The effective configuration as YAML."""
    can_freeze: bool = True
    """True if the map's method can freeze keyframes."""
    has_dates: bool = False
    """True if the map can be shown as of another time."""
    has_surface: bool = False
    """True if the map can make the surface that its keyframes measured."""
    counts_keyframes: bool = True
    """True if the map knows how many keyframes see a voxel."""
    has_frames: bool = True
    """True if the map is made from frames, and is not one from a file."""
    recordings: tuple[str, ...] = ()
    """Names of all that can be mapped instead, with ``recording``, the place of the source among them."""
    recording: int = 0
    located: str = ""
    """How sure the place of the frames is in the map of an earlier recording; empty if the map is theirs."""


@dataclass(frozen=True)
class Bricks(Update):
    """Bricks whose voxels may have changed, and bricks that were removed.

    ``bricks`` (n, 3) int32 brick coordinates; ``log_odds`` (n, 512) int16, see :data:`LOG_ODDS_STEP`;
    ``seen`` (n, 512) uint8, by how many keyframes' rays each voxel was crossed (255: 255 or more);
    ``removed`` (m, 3) int32.
    """

    layer: Layer
    bricks: NDArray[np.int32]
    log_odds: NDArray[np.int16]
    seen: NDArray[np.uint8]
    removed: NDArray[np.int32]


@dataclass(frozen=True)
class BrickColors(Update):
    """The colours that a ``layer`` gives to the voxels of all bricks of a ``chunk``, by default what cameras
    saw: ``bricks`` (n, 3) int32, ``colors`` (n, 512, 3) uint8 RGB."""

    chunk: tuple[int, int, int]
    bricks: NDArray[np.int32]
    colors: NDArray[np.uint8]
    layer: str = COLORS


@dataclass(frozen=True)
class SurfacePatch(Update):
    """The part of the measured surface in a ``chunk``, which takes the place of an earlier one; without
    ``triangles`` there is none any more.

    ``vertices_m`` (n, 3) float32 in metres, world; ``triangles`` (m, 3) int32, counter-clockwise as seen from
    free space; ``normals`` (n, 3) int8, 127 is one; ``std_m`` (n,) float32, the standard deviation along the
    normal; ``colors`` (n, 3) uint8 RGB that cameras saw, None if the map has none.
    """

    chunk: tuple[int, int, int]
    vertices_m: NDArray[np.float32]
    triangles: NDArray[np.int32]
    normals: NDArray[np.int8]
    std_m: NDArray[np.float32]
    colors: NDArray[np.uint8] | None


@dataclass(frozen=True)
class SurfaceView(Update):
    """All patches of the measured surface are sent; this is how the picture of a run shows it.

    ``eye_m`` and ``target_m`` are in metres, world; ``up`` and ``light``, towards the light, are unit vectors
    there; ``fov_rad`` is the vertical field of view. A ``photo`` is in the colours that cameras saw.
    """

    eye_m: NDArray[np.float64]
    target_m: NDArray[np.float64]
    up: NDArray[np.float64]
    light: NDArray[np.float64]
    fov_rad: float
    photo: bool


@dataclass(frozen=True)
class KeyframeInfo(Update):
    """A keyframe that is new or has changed.

    ``picture`` is a small depth image in colours, (h, w, 3) uint8. If ``camera`` is no pinhole, it is that of
    the picture's pixels; ``crossed`` (n, 3) int32 are the bricks
    that its rays cross, which are free where the map has no voxels. ``T_home`` is the pose that *Put back*
    restores. ``earlier``: it is of the map that the recording has joined. ``stamp_s`` counts as stamps do.
    """

    id: int
    name: str
    T_world_camera: Pose
    camera: Camera
    rays: int
    state: KeyframeState
    picture: NDArray[np.uint8]
    crossed: NDArray[np.int32]
    T_home: Pose
    earlier: bool = False
    stamp_s: float = 0.0


@dataclass(frozen=True)
class MeasuredPoints(Update):
    """Points that a keyframe measured: ``points_m`` (n, 3) float32 in metres, in its camera frame, and
    ``colors`` (n, 3) uint8 RGB, of its colour image or else those of depth; none of a frozen keyframe."""

    keyframe: int
    points_m: NDArray[np.float32]
    colors: NDArray[np.uint8]


@dataclass(frozen=True)
class CurrentCamera(Update):
    """The camera of the latest frame, whether that became a keyframe or not."""

    name: str
    T_world_camera: Pose
    camera: Camera


@dataclass(frozen=True)
class Status(Update):
    """Progress and figures. ``activity`` says what is being done, ``share`` how much of it is done (0 to 1),
    ``pending`` whether inference after an edit is not finished, ``speed`` is the multiple of the recording's
    pace (0: as fast as possible), None where frames have none. ``free_space`` says how sure free space is, if
    frames were held out for that. ``can_undo``, ``can_redo``: edits can be taken back, or made again.
    ``arrivals`` says how the frames of a sensor that runs come, empty for any other source; ``no_surface``
    why no surface can be made of the map, empty if one can. ``layers`` are those that pixels have fed
    (voxels/layers.py)."""

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
    speed: float | None = None
    free_space: str = ""
    can_undo: bool = False
    can_redo: bool = False
    arrivals: str = ""
    no_surface: str = ""
    layers: tuple[str, ...] = ()


@dataclass(frozen=True)
class TimeSpan(Update):
    """The times at which the map can be shown, from ``first_s`` to ``now_s`` in seconds, as stamps have them;
    and the one that is shown, None for now. ``start_s`` is the stamp from which the page counts."""

    start_s: float
    first_s: float
    now_s: float
    shown_s: float | None


@dataclass(frozen=True)
class SceneChange:
    """Something that appeared or left, up to ``stamp_s`` (seconds), in a box of ``size_m`` (3) around
    ``centre_m`` (3), metres, world."""

    stamp_s: float
    verb: Literal["appeared", "left"]
    size_m: tuple[float, float, float]
    centre_m: tuple[float, float, float]


@dataclass(frozen=True)
class SceneChanges(Update):
    """Things that have appeared or left lately, the latest first."""

    changes: tuple[SceneChange, ...]


@dataclass(frozen=True)
class Alive(Update):
    """Sent when there is nothing else to send: the mapping process still runs."""


@dataclass(frozen=True)
class Notice(Update):
    """A sentence for the user. ``gives_up`` is what the mapping process shows no more."""

    text: str
    severity: Literal["info", "warning", "error"] = "info"
    gives_up: Literal["", "baseline"] = ""


@dataclass(frozen=True)
class RayAnswer(Update):
    """The voxels along a ray, (n,) each, by range in metres; see queries.view.RayProfile.

    ``measured_m`` is the range that the keyframe measured, None without a measurement; ``bias_m`` and
    ``sigma_m`` are the sensor's noise at that range, along the ray.
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
class Votes(Update):
    """Votes of keyframes on the voxel at a point (metres, world), or of those of :class:`WhoSays` on average,
    the strongest first: the number of each, and the log-odds that it adds, above 0 for occupied. ``known`` is
    False if the map does not keep it, or not yet."""

    point: tuple[float, float, float]
    votes: tuple[tuple[int, float], ...]
    known: bool = True


@dataclass(frozen=True)
class Images(Update):
    """Images of one view, (h, w, 3) uint8 each; ``score`` is the sentence that goes with them."""

    title: str
    measured: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    accuracy: NDArray[np.uint8]
    score: str


@dataclass(frozen=True)
class File(Update):
    """A file for the browser of the client that asked for it."""

    name: str
    content: bytes
    client: int


@dataclass(frozen=True)
class Listening(Request):
    """The viewer's first message: the address of its page. ``port`` may differ from the one that was asked
    for."""

    host: str
    port: int

    @property
    def url(self) -> str:
        """Address of the page."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"


@dataclass(frozen=True)
class Pause(Request):
    """Pause the replay, or resume it."""

    on: bool


@dataclass(frozen=True)
class Step(Request):
    """Read frames up to the next keyframe, then pause."""


@dataclass(frozen=True)
class Speed(Request):
    """Replay at this multiple of the recording's pace; 0 is as fast as possible."""

    factor: float


@dataclass(frozen=True)
class Reset(Request):
    """Delete the map and start again: the same source, or the ``recording`` at this place of Hello's."""

    recording: int | None = None


@dataclass(frozen=True)
class Switch(Request):
    """Remove a keyframe from the map, or add it again; None for ``on`` turns it over. With ``last``, all
    keyframes up to that number that can be changed."""

    keyframe: int
    on: bool | None
    last: int | None = None


@dataclass(frozen=True)
class Freeze(Request):
    """Make a keyframe's evidence permanent."""

    keyframe: int


@dataclass(frozen=True)
class Move(Request):
    """Give a keyframe another pose."""

    keyframe: int
    T_world_camera: Pose


@dataclass(frozen=True)
class Undo(Request):
    """Take the last press of Switch or Move back, or make it ``again``."""

    again: bool = False


@dataclass(frozen=True)
class RayThrough(Request):
    """Show the ray of a camera through a point, (x, y, z) in metres, world: of ``keyframe`` if it sees the
    point, else of another one that does, else of the viewpoint ``eye``."""

    point: tuple[float, float, float]
    eye: tuple[float, float, float]
    keyframe: int | None


@dataclass(frozen=True)
class WhoSays(Request):
    """Ask what keyframes say of the voxels at some points, (x, y, z) in metres, world; the answer names the
    first one."""

    points: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Select(Request):
    """Note the voxels that a user has clicked on or framed, by their centres (n, 3) in metres, world; none
    once the answer is closed."""

    points_m: NDArray[np.float64]


@dataclass(frozen=True)
class PixelRay(Request):
    """Show the ray of a keyframe's pixel; ``u`` and ``v`` in pixels, (0, 0) is the centre of the first
    one."""

    keyframe: int
    u: float
    v: float


@dataclass(frozen=True)
class Watch(Request):
    """Which extras the page shows and the mapping process must keep up to date: images of ``view`` (a
    keyframe, or None for the current camera), the baseline beside the map, the ``counts`` of keyframes that
    see each voxel (else sent as 0), the ``colors`` that pixels give to voxels, the measured ``surface``, and
    the measured ``points`` of a keyframe."""

    images: bool
    view: int | None
    baseline: bool
    counts: bool = False
    colors: bool = False
    surface: bool = False
    points: int | None = None


@dataclass(frozen=True)
class ShowTime(Request):
    """Show the map as it was believed at a time in seconds, None for now; ``play`` goes on from there to
    later times, until now."""

    stamp_s: float | None
    play: bool = False


@dataclass(frozen=True)
class Save(Request):
    """Send a file to a client, and write it to the run's folder if there is one."""

    kind: Literal["map", "ply", "mesh"]
    client: int


@dataclass(frozen=True)
class Quit(Request):
    """The viewer has ended, or must end."""
