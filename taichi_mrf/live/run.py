"""The state of a live run: what is mapped, what has come of it, and who watches."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.errors import CapacityError, LostFrameError
from taichi_mrf.live.link import Link
from taichi_mrf.live.live_keyframes import Entry
from taichi_mrf.live.mapper import Mapper
from taichi_mrf.live.progress import Progress
from taichi_mrf.live.replay import Replay
from taichi_mrf.mapping.tracking import Track, tracker_of
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system import runtime
from taichi_mrf.viewer.messages import CurrentCamera, Hello, KeyframeInfo, Notice, Request, Update

WAY_BACK = "bring the camera back to where it was then, or to where it started"


def saved_unsettled(name: str) -> str:
    """What a user is told of a saved map whose inference was interrupted."""
    return (
        f"{name} was saved before its inference was complete. It is shown as it was saved; "
        "inference over all keyframes now completes it."
    )


@dataclass(frozen=True)
class Source:
    """What is mapped: how to make its map (an empty one, or one from a file), and how to replay its frames,
    which a saved map has not. ``tracked`` says that their poses are to be found."""

    name: str
    config: Config
    new_map: Callable[[], OccupancyMap]
    new_replay: Callable[[], Replay] | None = None
    tracked: bool = False


@dataclass(frozen=True)
class Policy:
    """What a run does by itself. ``keep_live``: most keyframes that are on before some are frozen, None
    for no limit. ``out``: folder for the files that a user saves. ``leave_when_done``: end once the source
    has ended and the map is settled."""

    keep_live: int | None = None
    out: Path | None = None
    leave_when_done: bool = False


class Run:
    """One live run. ``mapper`` holds the map; ``replay`` the frames, None if there are none to come.

    ``stepping`` says that one more keyframe is to be taken whatever the pace, ``ended`` that the run is over,
    ``current`` is the frame that was read last. ``waiting`` are the requests that have not been carried out.
    ``tracker`` finds the poses of a tracked source, and ``track`` remembers them for ``policy.out``.
    ``version`` changes with the map that is shown and with the current camera. ``full`` says why the last
    frame found no room in the map, None if it did.
    """

    def __init__(self, source: Source, link: Link, policy: Policy) -> None:
        """Makes the map. Raises TaichiMRFError."""
        self.source, self.link, self.policy = source, link, policy
        self.waiting: deque[Request] = deque()
        self.ended, self.version = False, 0
        self.full: str | None = None
        self.replay: Replay | None = None
        self.begin(first_id=0)

    def begin(self, first_id: int) -> None:
        """Forget the map, if there is one, and start the source from its beginning, at the speed in
        force. The viewer's numbers of keyframes begin at ``first_id``. What is raised leaves the old map in
        place."""
        poses = self.source.config.poses
        self.mapper = Mapper(self.source.new_map(), first_id, poses)
        self.tracker = tracker_of(self.mapper.map, poses) if self.source.tracked else None
        self.track = Track()
        replay = self.source.new_replay() if self.source.new_replay else None
        if replay is not None and self.replay is not None:
            replay.set_speed(self.replay.speed)
        self.replay = replay
        self.progress = Progress()
        self.current: Frame | None = None
        self.stepping, self.full = False, None
        self.greet()

    def greet(self) -> None:
        """Tell a viewer that knows nothing yet all that there is."""
        m, backend = self.mapper.map, runtime.choice()
        self.send(
            Hello(
                source=self.source.name,
                backend=backend.name if backend else "",
                device=backend.device if backend else "",
                method=m.config.method,
                voxel_size=m.voxel_size,
                prior_log_odds=m.view.pool.prior_log_odds,
                min_evidence=self.mapper.min_evidence,
                parameters=to_yaml(self.source.config),
            )
        )
        if self.mapper.saved_unsettled and self.mapper.unsettled:
            self.send(Notice(saved_unsettled(self.source.name), "warning"))
        for entry in self.mapper.roster.entries.values():
            self.send(self.mapper.describe(entry))
        if self.current is not None:
            self.show_camera(self.current)
        self.mapper.publisher.start_over()
        self.publish()

    def publish(self) -> None:
        """Send what has changed of the map, and take its measure."""
        changes = self.mapper.publisher.changes()
        if changes is not None:
            self.send(changes)
            self.version += 1
        self.progress.measure(self.mapper)

    def show_camera(self, frame: Frame) -> None:
        """Tell the viewer where a frame was taken."""
        self.current = frame
        self.version += 1
        self.send(CurrentCamera(frame.name, frame.T_world_camera, frame.camera))

    def located(self, frame: Frame) -> Frame | None:
        """The frame where it was taken; None if that cannot be found out, of which the viewer is told when it
        begins and when it is over."""
        if self.tracker is None:
            return frame
        lost = self.tracker.lost
        try:
            found, tracked = self.tracker.follow(frame)
        except LostFrameError as error:
            self.track.lost += 1
            if not lost:
                self.send(Notice(f"{error}; {WAY_BACK}", "warning"))
            return None
        if lost:
            self.send(Notice(f"{frame.name}: tracking goes on after {lost} lost frames"))
        if self.policy.out is not None:
            self.track.frames[len(self.track.frames)] = tracked
        return found

    def tracked_keyframe(self, entry: Entry) -> None:
        """The frame that was located last has become a keyframe."""
        if self.tracker is not None and entry.map_id is not None:
            tracked = self.tracker.took(entry.map_id)
            if self.track.frames:
                self.track.frames[len(self.track.frames) - 1] = tracked

    def describe(self, id: int) -> KeyframeInfo:
        """What the viewer must know of a keyframe."""
        return self.mapper.describe(self.mapper.roster.find(id))

    def send(self, update: Update) -> None:
        """Pass an update to the viewer."""
        self.link.send(update)

    def tell(self, activity: str, share: float, edits_wait: bool = False) -> None:
        """Tell the viewer what is being done, and how much of that is."""
        self.send(self.progress.status(activity, share, self.replay, self.mapper, edits_wait))

    def notice_error(self, error: Exception) -> None:
        """Tell the viewer that something went wrong; a map that is full also pauses the replay."""
        self.send(Notice(" ".join(str(error).split()) or type(error).__name__, "error"))
        if isinstance(error, CapacityError) and self.replay is not None:
            self.full = str(error)
            self.replay.pause()
            self.stepping = False

    def guarded(self, work: Callable[[], None]) -> bool:
        """Do some work; what goes wrong with one frame or one request must not end mapping, and becomes a
        notice. Returns whether it went well."""
        try:
            work()
        except Exception as error:
            self.notice_error(error)
            return False
        return True

    @property
    def has_frames_left(self) -> bool:
        """Whether the source has not ended."""
        return self.replay is not None and not self.replay.finished

    @property
    def is_replaying(self) -> bool:
        """Whether more frames are to come without anybody's doing, or one is that was asked for."""
        return (
            self.replay is not None and not self.replay.finished and (self.stepping or not self.replay.paused)
        )

    @property
    def is_done(self) -> bool:
        """Whether all frames are in the map, or as many as there is room for, and it is the one that they
        give."""
        frames_left = self.has_frames_left and self.full is None
        return not (frames_left or self.mapper.unsettled or self.mapper.unaligned)

    @property
    def idle_activity(self) -> str:
        """In words, why nothing is being done."""
        if self.replay is None:
            return "waiting: the map is up to date"
        if self.replay.finished:
            return self.replay.problem or "done: the map is up to date"
        return "waiting: paused" if self.replay.paused else "waiting for the next frame"
