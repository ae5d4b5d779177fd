"""Extras that the page shows beside the map: images of a view, the measured surface, what is occupied,
colours that cameras saw, and the same keyframes mapped by OctoMap's method."""

import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from taichi_mrf.config.registry import octomap_method
from taichi_mrf.config.schema import Config, without_window
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.schedule import InferProgress, Progress, StopRequestedError
from taichi_mrf.methods.capabilities import takes_colors
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.colored import painted
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.session.change_list import ChangeList
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.pictures import view_images
from taichi_mrf.session.publish import Publisher
from taichi_mrf.session.run import Run
from taichi_mrf.session.shown_surface import ShownSurface
from taichi_mrf.viewer.messages import BrickColors, Bricks, Notice, SceneChanges, Update, Watch
from taichi_mrf.voxels.layout import VOXELS, by_chunk

NOTHING = Watch(images=False, view=None, baseline=False)

IMAGE_SECONDS = 1.0
"""Shortest time between two sets of images, in seconds."""

COLOR_SHARE = 0.1
"""Looking for new colours takes at most this share of the time while frames come."""

ASK_SECONDS = 0.05
"""Shortest time between two looks at requests during long work, in seconds."""

LEAST_LOG_ODDS = 0.0
"""Bricks without any voxel more likely occupied than not are not sent: in this map every brick that a ray
crosses exists, seven in ten of them free at 2 cm, and a voxel seen to be free never falls below 0.12."""


class GoOn(Protocol):
    """Called between two steps of long work: carries out requests, and returns whether to go on."""

    def __call__(self, step: InferProgress | None = None) -> bool: ...


class Extras:
    """Keeps the extras up to date while there is no other work."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._watch = NOTHING
        self._baseline: BaselineOverlay | None = None
        self._changes: ChangeList | None = None
        self._colors: ShownColors | None = None
        self._surface: ShownSurface | None = None
        self._shown_version = -1
        self._images_made = float("-inf")

    def watch(self, wanted: Watch) -> None:
        """Set what the page shows; the work is done later."""
        if wanted != self._watch:
            self._watch, self._shown_version = wanted, -1

    @property
    def need_messages(self) -> bool:
        """True if the page shows what only messages tell: who sees a voxel, and its colour."""
        return self._watch.counts or self._watch.colors

    def start_again_for_viewer(self) -> None:
        """Show no extras, which a new viewer starts without; it is sent the list of changes."""
        self._watch, self._baseline, self._colors, self._surface = NOTHING, None, None, None
        if self._changes is not None:
            self._run.send(self._changes.listed())

    def start_over(self) -> None:
        """Start over with a new map; the page shows the same extras."""
        self._baseline, self._changes, self._colors, self._surface = None, None, None, None
        self._shown_version = -1

    def work(self, go_on: GoOn) -> bool:
        """Do one piece of the work that is left; returns whether there was any. ``go_on`` can stop it."""
        publisher = self._run.mapper.shown.publisher
        if publisher.counting != self._watch.counts:
            publisher.count(self._watch.counts)
            self._run.publish()
            return True
        if self._run.renew_past() or self._make_images() or self._list_changes() or self._send_colors():
            return True
        if self._decide(go_on) or self._send_surface(go_on):
            return True
        if not self._watch.baseline:
            if self._baseline is not None:
                self._run.send(self._baseline.everything_gone())
                self._baseline = None
            return False
        try:
            return self._catch_up(go_on)
        except Exception as error:  # mapping continues without the baseline
            self._run.send(Notice(f"baseline: {error}", "error"))
            self._watch = dataclasses.replace(self._watch, baseline=False)
            return True

    def answer(self) -> None:
        """During inference: make images of a newly chosen view, from the map before inference."""
        self._make_images()

    def _catch_up(self, go_on: GoOn) -> bool:
        mapper = self._run.mapper
        if self._baseline is None:
            self._baseline = BaselineOverlay(self._run.source.config, mapper.map.noise)
            frozen = len(mapper.roster.with_state("frozen"))
            if frozen:
                text = f"the baseline lacks {frozen} frozen keyframes: their images are no longer in memory"
                self._run.send(Notice(text, "warning"))
        if not self._baseline.catch_up(mapper, go_on):
            return False
        changes = self._baseline.changes()
        if changes is not None:
            self._run.send(changes)
        return True

    def _list_changes(self) -> bool:
        """Look for what appeared and what left; False if it was nothing."""
        if self._changes is None:
            self._changes = ChangeList(self._run.mapper)
        look = self._changes.look
        found: list[SceneChanges] = []
        self._run.guarded(lambda: found.extend(look()))
        for changes in found:
            self._run.send(changes)
        return bool(found)

    def _send_colors(self) -> bool:
        """Send the colours of voxels that have changed; False if there were none."""
        if not self._watch.colors:
            return False
        if self._colors is None:
            self._colors = ShownColors(self._run.mapper)
        changes = self._colors.changes
        found: list[BrickColors] = []
        self._run.guarded(lambda: found.extend(changes()))
        for colors in found:
            self._run.send(colors)
        return bool(found)

    def _send_surface(self, go_on: GoOn) -> bool:
        """Make the surface if it is shown, the map is at rest, and it has changed; False if there was
        nothing to do."""
        run = self._run
        if not (self._watch.surface and self._is_at_rest and run.mapper.roster.entries):
            return False
        if self._surface is None:
            self._surface = ShownSurface(run.mapper)
        if self._surface.is_current:
            return False
        try:
            between = self._between(go_on, "making the surface", lambda: self._watch.surface)
            news: Sequence[Update] = self._surface.news(between)
        except StopRequestedError:
            return True
        except Exception as error:  # mapping continues without the surface
            news = [*self._surface.nothing(), Notice(f"no surface: {error}", "warning")]
        for update in news:
            run.send(update)
        return True

    def _decide(self, go_on: GoOn) -> bool:
        """Count the votes of rays if the map is at rest and has changed; False if there was nothing to do."""
        run, shown = self._run, self._run.mapper.shown
        if not (self._is_at_rest and shown.lacks_decisions):
            return False
        try:
            run.decide(self._between(go_on, "finding what is occupied", lambda: True))
        except StopRequestedError:
            pass
        except Exception as error:  # marginals are shown instead
            run.send(Notice(f"shown by marginals: {error}", "error"))
            shown.give_up_deciding()
            run.publish()
        return True

    @property
    def _is_at_rest(self) -> bool:
        """True if no frames are read, and neither inference nor alignment follows, after which all that is
        made of the map would be made again."""
        run, mapper = self._run, self._run.mapper
        aligning = mapper.unaligned and mapper.refiner is not None and not run.has_frames_left
        return not (run.is_replaying or mapper.unsettled or aligning)

    def _between(self, go_on: GoOn, doing: str, wanted: Callable[[], bool]) -> Callable[[], None]:
        """Callback between steps of long work: now and then it carries out requests, and it raises
        StopRequestedError if the work is to end."""
        asked = time.monotonic()

        def between() -> None:
            nonlocal asked
            if time.monotonic() - asked < ASK_SECONDS:
                return
            self._run.show_activity(doing, 0.0)
            if not go_on() or not wanted():
                raise StopRequestedError
            asked = time.monotonic()

        return between

    def _make_images(self) -> bool:
        now = time.monotonic()
        old = self._watch.images and self._shown_version != self._run.version
        if not old or now - self._images_made < IMAGE_SECONDS:
            return False
        self._shown_version, self._images_made = self._run.version, now
        self._run.guarded(self._send_images)
        return True

    def _send_images(self) -> None:
        mapper, frame = self._run.mapper, self._run.current
        entry = None if self._watch.view is None else mapper.roster.entries.get(self._watch.view)
        if entry is not None:
            self._run.send(
                view_images(
                    mapper.map, entry.name, entry.camera, entry.T_world_camera, mapper.depth_of(entry)
                )
            )
        elif frame is not None:
            self._run.send(
                view_images(mapper.map, frame.name, frame.camera, frame.T_world_camera, frame.depth_m)
            )


class ShownColors:
    """Finds the colours to send of one map. While keyframes come, only theirs are added; once the map has
    settled, all are computed from its final marginals."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._sent: dict[tuple[int, int, int], bytes] = {}
        self._next = -math.inf
        self._seen: tuple[int, bool, int] | None = None

    def changes(self) -> list[BrickColors]:
        """The colours of the chunks that have changed since the last call, chunk by chunk; none if that was a
        moment ago."""
        m, begin = self._mapper.map, time.monotonic()
        if not takes_colors(m) or not m.has_colors or (begin < self._next and not m.settled):
            return []
        pool = m.view.pool
        state = pool.revision, m.settled, len(m.keyframes)
        if state == self._seen:
            return []
        self._seen = state
        slots = pool.in_use
        found = m.colors_in(slots) if m.settled else m.recent_colors().reshape(-1, VOXELS, 4)[slots]
        news = []
        for chunk, rows in by_chunk(pool.bricks[slots]):
            colors = painted(found[rows])
            digest = hashlib.blake2b(colors.tobytes(), digest_size=8).digest()
            if self._sent.get(chunk) != digest:
                self._sent[chunk] = digest
                news.append(BrickColors(chunk, np.ascontiguousarray(pool.bricks[slots[rows]]), colors))
        now = time.monotonic()
        self._next = now + (now - begin) / COLOR_SHARE
        return news


class BaselineOverlay:
    """A map by OctoMap's method that follows a mapper's keyframes, one piece of work at a time."""

    def __init__(self, config: Config, noise: NoiseModel) -> None:
        """An empty map with a configuration's parameters, but for the window, which its method lacks, and
        for time: OctoMap's update forgets nothing."""
        static = replace(without_window(config), time=TimeConfig())
        self.map: OccupancyMap = octomap_method().load_class().with_noise(static, noise)
        self._publisher = Publisher(
            "baseline",
            self.map.view.pool,
            self.map.seen_by,
            prior_is_unknown=True,
            least_log_odds=LEAST_LOG_ODDS,
        )
        self._places: dict[int, tuple[int, Pose]] = {}
        """The viewer's number of a keyframe -> its number and pose here."""
        self._stale = False

    def catch_up(self, mapper: Mapper, progress: Progress) -> bool:
        """Do one piece of the work that is left: add a keyframe, or integrate all anew after some have gone
        or moved, which ``progress`` can stop. Returns whether there was any.

        A frozen keyframe that is in this map stays in it; one that was frozen before cannot be added.
        """
        entries = mapper.roster.entries
        for id, (here, pose) in list(self._places.items()):
            entry = entries.get(id)
            if entry is None or entry.state == "off":
                self.map.remove_keyframe(here)
                del self._places[id]
                self._stale = True
            elif not np.array_equal(entry.T_world_camera, pose):
                self.map.move_keyframe(here, entry.T_world_camera)
                self._places[id] = here, entry.T_world_camera
                self._stale = True
        if self._stale:
            self._stale = not self.map.infer(progress=progress).complete
            return True
        for entry in mapper.roster.with_state("on"):
            if entry.id not in self._places:
                image = mapper.posed_image(entry)
                parts = (entry.T_world_camera, entry.camera, entry.name, entry.stamp_s)
                here = self.map.add_keyframe(image.depth_m, *parts, **image.own.arguments())
                self._places[entry.id] = here, entry.T_world_camera
                return True
        return False

    def changes(self) -> Bricks | None:
        """The changes that were not sent yet; None while the map is being rebuilt."""
        return None if self._stale else self._publisher.changes()

    def start_over(self) -> None:
        """Send the whole map with the next changes: the viewer is a new one."""
        self._publisher.start_over()

    def everything_gone(self) -> Bricks:
        """The update that removes this map from the page."""
        return self._publisher.everything_gone()
