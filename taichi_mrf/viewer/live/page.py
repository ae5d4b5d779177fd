"""The live page: what updates and events do to its scene and its widgets."""

from collections.abc import Callable
from functools import partial

import numpy as np
import viser
import viser.transforms as vtf
from numpy.typing import NDArray

from taichi_mrf.geometry.up import up_of
from taichi_mrf.sensor.camera import forwards
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.answer import SWITCHES, VoxelAnswer, beside, facts_of, facts_of_many
from taichi_mrf.viewer.live.panel import (
    CHOSEN_KEYFRAME,
    POSITION_STEP_M,
    RECORD,
    SPEEDS,
    Clicked,
    Dragged,
    Framed,
    Panel,
)
from taichi_mrf.viewer.live.time_strip import PLAY_TIME
from taichi_mrf.viewer.scene.base_page import POP_UP_S, BasePage
from taichi_mrf.viewer.scene.base_panel import Inbox
from taichi_mrf.viewer.scene.coloring import COLORINGS
from taichi_mrf.viewer.scene.keyframe_layer import first_pixel, first_voxel, framed
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.viewpoint import Side
from taichi_mrf.viewer.scene.widgets import change, in_markdown
from taichi_mrf.viewer.transport.pulse import LINK

MOST_ASKED = 32
"""Of as many voxels in a rectangle keyframes are asked at most."""

_PLAIN = ViewOptions(draw_as="voxels")
"""Options that the mapping process serves unless it is asked for more."""


class Page(BasePage[Panel]):
    """One page for all browsers that show it."""

    def __init__(self, server: viser.ViserServer, ask: Callable[[m.Request], None]) -> None:
        """``ask`` sends a request to the mapping process and does not wait."""
        inbox = Inbox()
        super().__init__(server, ask, inbox, Panel(server.gui, server.scene, inbox.put))
        self._hello: m.Hello
        self._question: m.RayThrough | m.WhoSays  # what the answer beside the click is about
        self._facts: Callable[[], dict[str, str]]  # what the page itself knows of it
        self.answer = VoxelAnswer(server.scene, self.panel)
        self._waits = False  # whether the scene says that the map is empty
        self._in_photo = False  # whether the page has opened in the colours of photographs
        self.handlers |= {
            m.Hello: self._begin,
            m.Bricks: lambda bricks: None if self.map is None else self.map.take(bricks),
            m.BrickColors: lambda colors: None if self.map is None else self.map.paint(colors),
            m.SurfacePatch: lambda patch: None if self.map is None else self.map.surface.take(patch),
            m.SurfaceView: self._take_surface_view,
            m.KeyframeInfo: self._take_keyframe,
            m.File: self._take_file,
            m.CurrentCamera: self._take_camera,
            m.Status: self._take_status,
            m.RayAnswer: self._show_ray,
            m.Votes: self._show_votes,
            m.Images: self.panel.show_images,
            m.TimeSpan: self._take_span,
            m.SceneChanges: self._take_changes,
            m.MeasuredPoints: self._take_points,
            Clicked: self._clicked,
            Framed: self._framed,
            Dragged: self._dragged,
        }
        self.actions |= {
            "Play": lambda client: ask(m.Pause(False)),
            "Pause": lambda client: ask(m.Pause(True)),
            "Step": lambda client: ask(m.Step()),
            "Speed": lambda client: ask(m.Speed(SPEEDS[self.panel.speed.value])),
            "Follow": lambda client: self.panel.set_following(),
            "Reset": self._reset,
            "Undo": lambda client: ask(m.Undo()),
            "Redo": lambda client: ask(m.Undo(again=True)),
            "Recording": self._choose_recording,
            "Keyframe": lambda client: self._choose(self.panel.chosen_keyframe()),
            "On/off": lambda client: self._edit(lambda k: m.Switch(k.id, None)),
            "All off": lambda client: self._switch_range(False),
            "All on": lambda client: self._switch_range(True),
            "Freeze": self._freeze,
            "Move": lambda client: self._toggle_gizmo(),
            "Put back": lambda client: self._edit(lambda k: m.Move(k.id, k.T_home)),
            "Position (m)": lambda client: self._edit(self._move_as_typed),
            "Show the ray": lambda client: self._edit(lambda k: m.PixelRay(k.id, *self.panel.pixel.value)),
            "Show images": lambda client: self._watch_images(),
            "Images of": lambda client: self._watch_images(),
            "Time (s)": self._scrub,
            PLAY_TIME: lambda client: ask(m.ShowTime(self.panel.time.played_s(), play=True)),
            "Map (.npz)": lambda client: ask(m.Save("map", client)),
            "Voxels (.ply)": lambda client: ask(m.Save("ply", client)),
            "Mesh (.ply)": lambda client: ask(m.Save("mesh", client)),
            "Picture (.png)": self.downloads.picture,
            LINK: self._tell_of_link,
            "Page (.html)": self.downloads.page,
            RECORD: self._record,
            "Close": lambda client: self._close_answer(),
            **{name: partial(self._switch_off, i) for i, name in enumerate(SWITCHES)},
        }
        server.scene.on_click()(lambda event: inbox.put(_click_of(event)))
        server.scene.on_rect_select(modifier="shift")(
            lambda event: inbox.put(Framed(event.client_id, np.array([event.screen_min, event.screen_max])))
        )

    def options_changed(self, before: ViewOptions) -> None:
        """Tell the mapping process which extras are shown, and follow the camera if asked."""
        self.viewpoint.set_following(self.options.follow)
        if self._extras(self.options) != self._extras(before):
            self._ask_for_extras()

    def notify(self, notice: m.Notice) -> None:
        """Show a notice, and no box as ticked for what there is no more."""
        super().notify(notice)
        if notice.gives_up:
            self.panel.view_options.handles[notice.gives_up].value = False
            self._take_options()

    def look_from(self, side: Side, client: int) -> None:
        """Show the whole map to one client, and follow the camera no more."""
        self.panel.set_following(False)
        self._take_options()
        super().look_from(side, client)

    def _begin(self, hello: m.Hello) -> None:
        """Start with an empty map."""
        if self.map is not None and hello.recording != self._hello.recording:
            self.viewpoint.start_over()
        self.begin_map(hello)
        self._hello, self._in_photo = hello, False
        self.viewpoint.has_strip = hello.has_dates
        self.answer.clear()
        change(self.panel.unsaved, visible=False)
        self.keyframes.clear()
        self.panel.ray.clear()
        self.panel.show_hello(hello)
        self.panel.show_keyframes({}, None)
        self.options = self.panel.view_options.value()  # what this map cannot show is not offered any more
        if self._extras(self.options) != self._extras(_PLAIN):
            self._ask_for_extras()

    def _take_status(self, status: m.Status) -> None:
        self.panel.show_status(status)
        self._show_waiting(status)
        self.panel.show_history(status.can_undo, status.can_redo)
        growing = not (status.paused or status.finished)
        if self.map is not None and growing != self.map.growing:
            before = self._extras(self.options)
            self.map.growing = growing
            self.map.look_changed()
            if growing:
                self.viewpoint.look_at_everything()
            if self._extras(self.options) != before:
                self._ask_for_extras()

    def _show_waiting(self, status: m.Status) -> None:
        """Say in the scene what an empty map waits for."""
        empty = not (status.voxels or self.keyframes.keyframes)
        if empty != self._waits:
            self._waits = empty
            self.server.scene.remove_by_name("/waiting")
            if empty:
                ended = self._hello.has_frames and status.finished
                text = "no frame became a keyframe" if ended else "waiting for the first keyframe"
                self.server.scene.add_label("/waiting", text)

    def _take_surface_view(self, view: m.SurfaceView) -> None:
        """Show the surface as the picture of a run does: the first time also in its colours."""
        if self.map is None:
            return
        self.map.surface.take_view(view)
        self.viewpoint.look_as_pictured(view, self.map.surface.vertices())
        if view.photo and not self._in_photo:
            self._in_photo = True
            self.panel.show_in_photo_colors()

    def _take_keyframe(self, keyframe: m.KeyframeInfo) -> None:
        if not self.keyframes.keyframes:
            self.viewpoint.set_up(up_of(keyframe.T_world_camera, keyframe.camera.up))
            self.keyframes.chosen = keyframe.id
            if self.options.points:
                self._ask_for_extras()
        if self._hello.has_frames or keyframe.id in self.keyframes.keyframes:
            change(self.panel.unsaved, visible=True)
        is_first = not keyframe.earlier and all(k.earlier for k in self.keyframes.keyframes.values())
        if self._hello.located and self.map is not None and is_first:
            self.map.note_earlier()
        self.keyframes.put(keyframe)
        self.keyframes.draw_path()
        if self.map is not None:
            self.map.move_measured(keyframe.id, keyframe.T_world_camera)
        self.panel.show_keyframes(self.keyframes.keyframes, self.keyframes.chosen)

    def _take_span(self, span: m.TimeSpan) -> None:
        self.panel.time.show_span(span, self.keyframes.keyframes.values())
        self._show_way_until(span.shown_s)

    def _scrub(self, client: int) -> None:
        """Show where the camera was at the chosen time at once; the map of that time comes later."""
        stamp_s = self.panel.time.chosen_s()
        self._show_way_until(stamp_s)
        self.ask(m.ShowTime(stamp_s))

    def _show_way_until(self, stamp_s: float | None) -> None:
        self.keyframes.show_until(stamp_s)
        self.panel.time.show_nearest(self.keyframes.keyframes.values(), stamp_s)

    def _take_changes(self, changes: m.SceneChanges) -> None:
        self.panel.time.show_changes(changes)
        if self.map is not None:
            self.map.changes = changes.changes
            self.map.look_changed()

    def _take_points(self, measured: m.MeasuredPoints) -> None:
        """Show what a keyframe measured, unless another one has been chosen meanwhile."""
        if self.map is not None and measured.keyframe == self.keyframes.chosen:
            T_world_camera = self.keyframes.keyframes[measured.keyframe].T_world_camera
            self.map.show_measured(measured, T_world_camera)
            self.map.look_changed()

    def _take_file(self, file: m.File) -> None:
        self.downloads.send(file.client, file.name, file.content)
        if file.name.endswith(".npz"):
            change(self.panel.unsaved, visible=False)

    def _take_camera(self, camera: m.CurrentCamera) -> None:
        self.keyframes.show_camera(camera)
        self.viewpoint.camera_moved(camera.T_world_camera, forwards(camera.camera))

    def _show_ray(self, answer: m.RayAnswer) -> None:
        """Show the answer. If the ray is one of the chosen keyframe, fill in the pixel: the button then shows
        the same ray again."""
        self.panel.ray.show(answer)
        if answer.pixel is not None and self.keyframes.chosen == answer.keyframe:
            self.panel.pixel.value = (float(answer.pixel[0]), float(answer.pixel[1]))

    def _reset(self, client: int) -> None:
        """Ask before a map with keyframes is deleted."""
        self.request(
            client,
            m.Reset(),
            bool(self.keyframes.keyframes),
            "Reset the map?",
            "This deletes the map and all edits of its keyframes, and maps the source again from its first "
            "frame. To keep the map, save it first.",
            "Delete the map and start again",
            "Keep the map",
        )

    def _choose_recording(self, client: int) -> None:
        """Ask before changes are lost with the map. The dropdown shows what is mapped, until a Hello says
        that it is another one."""
        chosen = self.panel.recording.value
        self.panel.show_recording(self._hello)
        if chosen != self.panel.recording.value:
            self.request(
                client,
                m.Reset(self._hello.recordings.index(chosen)),
                self.panel.unsaved.visible,
                "Discard changes?",
                "The map has changes that are not saved; a map of another recording takes its place.",
                "Discard them",
                "Keep the map",
            )

    def _freeze(self, client: int) -> None:
        """Ask before the chosen keyframe is frozen."""
        chosen = self._changeable()
        if chosen is not None:
            self.request(
                client,
                m.Freeze(chosen.id),
                True,
                "Freeze the keyframe?",
                f"This makes the evidence of keyframe {chosen.id} ({in_markdown(chosen.name)}) permanent and "
                "drops its image: it can never be switched off, moved or looked at again.",
                "Freeze it",
                "Leave it as it is",
            )

    def _record(self, client: int) -> None:
        self.downloads.toggle_recording(client)
        self.show_counts()

    def _tell_of_link(self, client: int) -> None:
        """Say what the page's script has done in the client's browser."""
        handle = self.server.get_clients().get(client)
        if handle is not None:
            text = "The address of this page now leads to this view. It is copied if the browser allows that."
            handle.add_notification("Link", text, auto_close_seconds=POP_UP_S)

    def _edit(self, request_for: Callable[[m.KeyframeInfo], m.Request]) -> None:
        """Send a request about the chosen keyframe, unless it is frozen or there is none."""
        chosen = self._changeable()
        if chosen is not None:
            self.ask(request_for(chosen))

    def _switch_range(self, on: bool) -> None:
        """Switch all keyframes from one number to another on or off."""
        first, last = self.panel.range.value
        known = [id for id in self.keyframes.keyframes if first <= id <= last]
        if known:
            self.ask(m.Switch(min(known), on, max(known)))

    def _changeable(self) -> m.KeyframeInfo | None:
        """The chosen keyframe; None, with a notice that says why, if it cannot be changed."""
        info = None if self.keyframes.chosen is None else self.keyframes.keyframes[self.keyframes.chosen]
        if info is not None and info.state != "frozen":
            return info
        frozen = info and f"Keyframe {info.id} ({info.name}) is frozen: it cannot be changed."
        self.notify(m.Notice(frozen or "There is no keyframe yet.", "warning"))
        return None

    def _move_as_typed(self, keyframe: m.KeyframeInfo) -> m.Request:
        """The boxes hold rounded numbers; only a coordinate that differs by more than the rounding moves."""
        T = keyframe.T_world_camera.copy()
        typed = np.array(self.panel.position.value)
        T[:3, 3] = np.where(np.abs(typed - T[:3, 3]) > 0.51 * POSITION_STEP_M, typed, T[:3, 3])
        return m.Move(keyframe.id, T)

    def _toggle_gizmo(self) -> None:
        if self.keyframes.gizmo is not None:
            self.keyframes.release()
        elif self._changeable() is not None:
            gizmo = self.keyframes.grab(None if self.map is None else self.map.box_m())
            gizmo.on_update(
                lambda event: (
                    None if event.phase == "update" else self.inbox.put(Dragged(event.phase == "start"))
                )
            )

    def _dragged(self, dragged: Dragged) -> None:
        self.keyframes.held = dragged.holding
        gizmo, keyframe = self.keyframes.gizmo, self.keyframes.chosen
        if gizmo is not None and keyframe is not None and not dragged.holding:
            pose = vtf.SE3(np.array([*gizmo.wxyz, *gizmo.position], np.float64))
            self.ask(m.Move(keyframe, np.asarray(pose.as_matrix(), np.float64)))

    def _choose(self, keyframe: int | None) -> None:
        if keyframe == self.keyframes.chosen:
            return
        self.keyframes.release()
        self.keyframes.choose(keyframe)
        self.panel.show_keyframes(self.keyframes.keyframes, keyframe)
        watched = self.panel.images.value and self.panel.view.value == CHOSEN_KEYFRAME
        if watched or self.options.points:
            self._ask_for_extras()

    def _watch_images(self) -> None:
        if not self.panel.images.value:
            self.panel.show_images(None)
        self._ask_for_extras()

    def _ask_for_extras(self) -> None:
        """Tell the mapping process which extras the page shows."""
        view = self.keyframes.chosen if self.panel.view.value == CHOSEN_KEYFRAME else None
        self.ask(m.Watch(self.panel.images.value, view, *self._extras(self.options)))

    def _clicked(self, click: Clicked) -> None:
        """A click on a keyframe's picture chooses it and asks for the pixel's ray; a click on a voxel asks
        for a ray to it."""
        if self.map is None:
            return
        shown = [k for k in self.keyframes.keyframes.values() if k.state != "frozen"]
        pixel = first_pixel(click.origin, click.direction, shown if self.options.keyframes else [])
        voxel = first_voxel(click.origin, click.direction, self.map.points(), self._hello.voxel_size)
        if pixel is not None and (voxel is None or pixel.range_m < voxel[1]):
            self._choose(pixel.keyframe)
            if pixel.point is None:
                self.ask(m.PixelRay(pixel.keyframe, pixel.u, pixel.v))
            else:
                x, y, z = pixel.point.tolist()
                self.ask(m.RayThrough((x, y, z), click.origin, pixel.keyframe))
        elif voxel is not None:
            point_m = self.map.voxel_near(voxel[0])
            x, y, z = point_m.tolist()
            self._facts = partial(facts_of, point_m, self.map.store, self._hello)
            self._answer(
                m.RayThrough((x, y, z), click.origin, self.keyframes.chosen), point_m[None], click.place
            )

    def _framed(self, drawn: Framed) -> None:
        """Say how large what is seen in a rectangle is, and ask which keyframes say that it is there."""
        handle = self.server.get_clients().get(drawn.client)
        if handle is None or self.map is None:
            return
        seen = framed(handle.camera, drawn.corners, self.map.points(), self._hello.voxel_size)
        voxels = self.map.voxels_at(seen)
        if len(voxels):
            middle = voxels[np.argsort(np.linalg.norm(voxels - np.median(voxels, axis=0), axis=1))]
            asked = middle[:: -(-len(voxels) // MOST_ASKED)]
            self._facts = partial(facts_of_many, len(voxels), seen)
            question = m.WhoSays(tuple((x, y, z) for x, y, z in asked.tolist()))
            self._answer(question, voxels, beside(handle.camera, drawn.corners.max(axis=0)))

    def _answer(
        self, question: m.RayThrough | m.WhoSays, voxels: NDArray[np.float64], place: tuple[float, float]
    ) -> None:
        """Open the answer to a question about ``voxels`` (n, 3) at a ``place`` in the window, and ask it."""
        self._question = question
        self.ask(m.Select(voxels))
        self.answer.move(question.point if isinstance(question, m.RayThrough) else question.points[0], place)
        self.answer.show(self._facts() | self._when())
        self.ask(question)

    def _show_votes(self, answer: m.Votes) -> None:
        if self.map is not None and answer.point == self.answer.point:
            known = self.keyframes.keyframes
            votes = [(known[id], log_odds) for id, log_odds in answer.votes if id in known]
            self.answer.show(self._facts() | self._when(), votes, answer.known)

    def _when(self) -> dict[str, str]:
        """The time that facts are of, if it is an earlier one; what keyframes say is of now."""
        past_s = self.panel.time.past_s
        return {} if past_s is None else {"as of": f"{past_s:.1f} s; what keyframes say is of now"}

    def _close_answer(self) -> None:
        """Close the answer, and take its ray out of the scene; the plot stays."""
        self.answer.clear()
        self.ask(m.Select(np.zeros((0, 3))))
        self.server.scene.remove_by_name("/ray")

    def _switch_off(self, place: int, client: int) -> None:
        """Switch off the keyframe at a place of the answer's list, and show what the others say of the
        voxel."""
        listed = self.answer.said_by[place : place + 1]
        if listed and self.keyframes.keyframes[listed[0]].state == "on" and self.answer.point is not None:
            self.ask(m.Switch(listed[0], False))
            self.ask(self._question)

    def _extras(self, options: ViewOptions) -> tuple[bool, bool, bool, bool, int | None]:
        """Needs of the options: the baseline's map, the counts of keyframes, the colours of voxels, the
        measured surface, which may have colours of its own, and the keyframe whose points are shown."""
        coloring, surface = COLORINGS[options.color_by], options.draw_as == "surface"
        growing = self.map is None or self.map.growing
        needs = "" if surface and coloring.surface and not growing else coloring.needs
        points = self.keyframes.chosen if options.points else None
        return options.baseline, needs == "counts", needs == "colors", surface, points


def _click_of(event: viser.SceneClickEvent) -> Clicked:
    place = beside(event.client.camera, event.screen_pos)
    return Clicked(event.ray_origin, event.ray_direction, place)
