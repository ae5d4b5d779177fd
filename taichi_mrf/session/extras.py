"""Extras beside the map: on the page images of a view, the measured surface, what is occupied, colours that
cameras saw, and the same keyframes mapped by OctoMap's method; elsewhere the map's messages."""

import dataclasses
import time
from collections.abc import Callable, Sequence

from taichi_mrf.inference.schedule import InferProgress, StopRequestedError
from taichi_mrf.session.message_server import MessageServer
from taichi_mrf.session.pictures import view_images
from taichi_mrf.session.run import Run
from taichi_mrf.session.session_core import WAIT_SECONDS
from taichi_mrf.session.shown_extras import BaselineOverlay, ChangeList, ShownColors, ShownSurface
from taichi_mrf.viewer.messages import Notice, Update, Watch

NOTHING = Watch(images=False, view=None, baseline=False)

IMAGE_SECONDS = 1.0
"""Shortest time between two sets of images, in seconds."""

ASK_SECONDS = 0.05
"""Shortest time between two looks at requests during long work, in seconds."""

GoOn = Callable[[InferProgress | None], bool]
"""Called between two steps of long work, of inference with its step. Carries out requests, and returns if
work goes on."""


class Extras:
    """Keeps the extras up to date while there is no other work."""

    def __init__(self, run: Run, server: MessageServer | None = None) -> None:
        self._run, self._server = run, server
        self._watch = NOTHING
        self._baseline: BaselineOverlay | None = None
        self._changes: ChangeList | None = None
        self._colors: ShownColors | None = None
        self._surface: ShownSurface | None = None
        self._shown_version = -1
        self._images_made = float("-inf")
        self._points_of: int | None = None

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
        self._points_of = None
        if self._changes is not None:
            self._run.send(self._changes.listed())

    def start_over(self) -> None:
        """Start over with a new map; the page shows the same extras."""
        self._baseline, self._changes, self._colors, self._surface = None, None, None, None
        self._shown_version, self._points_of = -1, None
        if self._server is not None:
            self._server.start_over()

    def work(self, go_on: GoOn) -> bool:
        """Do one piece of the work that is left; returns whether there was any. ``go_on`` can stop it."""
        served = self._send_message()
        publisher = self._run.mapper.shown.publisher
        if publisher.counting != self._watch.counts:
            publisher.count(self._watch.counts)
            self._run.publish()
            return True
        if self._run.renew_past() or self._make_images() or self._list_changes() or self._send_colors():
            return True
        if self._send_points():
            return True
        if self._decide(go_on) or self._send_surface(go_on):
            return True
        if not self._watch.baseline:
            if self._baseline is not None:
                self._run.send(self._baseline.everything_gone())
                self._baseline = None
            return served
        try:
            return self._catch_up(go_on)
        except Exception as error:  # mapping continues without the baseline
            self._run.send(Notice(f"baseline: {error}", "error", gives_up="baseline"))
            self._watch = dataclasses.replace(self._watch, baseline=False)
            return True

    def answer(self) -> None:
        """During inference: make images of a newly chosen view, from the map before inference, and show the
        points of a newly chosen keyframe."""
        self._make_images()
        self._send_points()

    def _catch_up(self, go_on: GoOn) -> bool:
        mapper = self._run.mapper
        if self._baseline is None:
            self._baseline = BaselineOverlay(self._run.source.config, mapper.map.noise)
            frozen = mapper.roster.frozen
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
        return self._send_found(self._changes.look)

    def _send_colors(self) -> bool:
        """Send the colours of voxels that have changed; False if there were none."""
        if not self._watch.colors:
            return False
        if self._colors is None:
            self._colors = ShownColors(self._run.mapper)
        return self._send_found(self._colors.changes)

    def _send_points(self) -> bool:
        """Send what a newly chosen keyframe measured; False if none was chosen."""
        wanted, before = self._watch.points, self._points_of
        if wanted is not None and wanted not in self._run.mapper.roster.entries:
            return False
        self._points_of = wanted
        if wanted is None or wanted == before:
            return False
        self._run.guarded(lambda: self._run.send(self._run.mapper.points_of(wanted)))
        return True

    def _send_found(self, find: Callable[[], Sequence[Update]]) -> bool:
        """Send the updates that are found, if finding them raises nothing; False if there are none."""
        found: list[Update] = []
        self._run.guarded(lambda: found.extend(find()))
        for update in found:
            self._run.send(update)
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

    def _send_message(self) -> bool:
        """Send a message to those who subscribe if one is due; a run that ends by itself waits for it.
        Returns whether there was anything to do."""
        run, server = self._run, self._server
        at_rest = self._is_at_rest
        if server is None or (at_rest and run.mapper.shown.lacks_decisions):
            return False
        m, entries = run.mapper.map, run.mapper.roster.entries.values()
        poses = {each.stamp_s: each.T_world_camera for each in entries if each.state != "off"}
        sent = False

        def send() -> None:
            nonlocal sent
            sent = server.send(m, at_rest, poses)

        if not run.guarded(send):
            return True
        wait_s = server.due_in(m, at_rest) if at_rest and run.policy.leave_when_done and not sent else None
        if wait_s is not None:
            run.link.wait(min(wait_s, WAIT_SECONDS))
        return sent or wait_s is not None

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
            if not go_on(None) or not wanted():
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
