"""The widgets of the live page."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.config.text import field_help
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.time_strip import TimeStrip
from taichi_mrf.viewer.scene.base_panel import BasePanel, Event, Tell, rows_html
from taichi_mrf.viewer.scene.map_scene import GROWING
from taichi_mrf.viewer.scene.ray_plot import RayPlot
from taichi_mrf.viewer.scene.view_options import Draw, ViewOptions
from taichi_mrf.viewer.scene.widgets import change, in_html, in_markdown
from taichi_mrf.viewer.transport.pulse import LINK
from taichi_mrf.voxels.layers import COLORS


@dataclass(frozen=True)
class Clicked(Event):
    """A click into the scene: the ray from the viewpoint, in the world frame, metres; and the ``place`` in
    the window, pixels from its upper left corner."""

    origin: tuple[float, float, float]
    direction: tuple[float, float, float]
    place: tuple[float, float]


@dataclass(frozen=True)
class Framed(Event):
    """A client has drawn a rectangle over the scene, with these ``corners`` (2, 2), shares of the window."""

    client: int
    corners: NDArray[np.float64]


@dataclass(frozen=True)
class Dragged(Event):
    """The gizmo was grabbed, or let go where it is now."""

    holding: bool


RUN_BUTTONS = ("Pause", "Play", "Step", "Reset")
"""Of the first two only one is offered, and of all but the last none once no frames are left."""
HISTORY_BUTTONS = ("Undo", "Redo")
COMMANDS = {
    "Return to the opening view": ("Home", "H", None),
    "Look from the top": ("Top", "1", None),
    "Look from the front": ("Front", "2", None),
    "Look from the side": ("Side", "3", None),
    "Fit what is seen into the window": ("Fit", "0", None),
    "Follow the camera, or stop following": ("Follow", "F", None),
    "Undo the last edit": ("Undo", "Z", "cmd/ctrl"),
    "Redo the edit": ("Redo", "Z", "cmd/ctrl+shift"),
}
"""Entries of the command palette: action, key, and the key that is held with it."""
EDIT_BUTTONS = ("On/off", "Freeze", "Move", "Put back")
RECORD = "Recording (.viser)"
SAVE_BUTTONS = {
    "Map (.npz)": "The map with its keyframes, for `taichi-mrf live` and `MRFMap.load`.",
    "Voxels (.ply)": "The voxels with probability 0.5 or more, for MeshLab, CloudCompare or Blender.",
    "Mesh (.ply)": "The surface that the keyframes measured, as `taichi-mrf export --mesh` writes it.",
    "Picture (.png)": "What this browser shows.",
    LINK: "Put what this browser looks at into the page's address, and copy that.",
    "Page (.html)": "The scene in one file that any browser opens, without a server.",
    RECORD: "Start recording the scene; press again to get the file.",
}
RAY_BYTES, COLORED_BYTES, VOXEL_BYTES = 0.6, 1.0, 1.3
"""Bytes that a measured pixel, without and with its colour, and a voxel of the map take in a map's file, as
measured on four recordings, of which none is a third off."""
POINT_BYTES, TRIANGLE_BYTES = 26, 29
"""Bytes of a voxel in voxels.ply, and of a triangle with its share of vertices in mesh.ply."""
SPEEDS = {"as fast as possible": 0.0, "0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0, "4x": 4.0}
CURRENT_CAMERA, CHOSEN_KEYFRAME = "current camera", "chosen keyframe"
NO_KEYFRAME = "none yet"
POSITION_STEP_M = 0.01


class Panel(BasePanel):
    """Adds the widgets, and shows values in them."""

    def __init__(self, gui: viser.GuiApi, scene: viser.SceneApi, tell: Tell) -> None:
        super().__init__(gui, tell)
        self._names: dict[str, int] = {}
        self._no_surface, self._chosen = "", (ViewOptions().draw_as, ViewOptions().color_by)
        self._all = (0.0, 0.0)
        self._rays, self._voxels, self._colored = 0, 0, False
        self._thumbnail_of: NDArray[np.uint8] | None = None
        hint = "Map another recording of this folder; unsaved changes are asked about first."
        self.recording = self.watch(gui.add_dropdown("Recording", [""], visible=False, hint=hint))
        self._run: Any = self.add_buttons("Run", RUN_BUTTONS)
        hint = "Replay the recording at this multiple of its own pace."
        self.speed = self.watch(gui.add_dropdown("Speed", list(SPEEDS), hint=hint))
        self.add_legend()
        self.add_counts()
        self.add_buttons(
            "View",
            ("Home", "Top", "Front", "Side", "Fit"),
            "Keys H, 1, 2, 3 and 0; F follows the camera, Ctrl-K lists all keys.",
        )
        self.view_options.add("follow")
        for label, command in COMMANDS.items():
            self.add_command(label, *command)
        hint = "Ctrl-Z takes the last edit back, Ctrl-Shift-Z makes it again; a frozen keyframe stays."
        self._history: Any = self.add_buttons("Edits", HISTORY_BUTTONS, hint)
        self.show_history(False, False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Map"):
            self.add_layers("follow")
            self.add_button(*self.DARK_OR_LIGHT)
        with tabs.add_tab("Keyframes"):
            self._keyframe_tab()
        with tabs.add_tab("Ray"):
            self._ray_tab(scene)
        with tabs.add_tab("Images"):
            self._images_tab()
        with tabs.add_tab("Save"):
            self.unsaved = gui.add_markdown("The map has changes that are not saved.", visible=False)
            self._size = gui.add_markdown("")
            self._save = {name: self.add_button(name, hint, name) for name, hint in SAVE_BUTTONS.items()}
        with tabs.add_tab("About"):
            self._numbers = gui.add_html("")
            self.add_notices()
            self._parameters = gui.add_html("")
        self.time = TimeStrip(gui, self)

    def show_hello(self, hello: m.Hello) -> None:
        """Show the source, the backend and the parameters."""
        self._hello = hello
        self.show_recording(hello)
        self.time.begin(hello.has_dates)
        self.show_lack_of_surface("")
        self.offer(hello)
        self._parameters.content = (
            '<div style="margin:0.5em 0.75em;font-size:0.85em">Parameters'
            f'<pre style="overflow:auto;margin:0.3em 0">{in_html(hello.parameters)}</pre></div>'
        )
        self._edits.options = tuple(label for label in EDIT_BUTTONS if hello.can_freeze or label != "Freeze")
        self.view.options = (CURRENT_CAMERA, CHOSEN_KEYFRAME) if hello.has_frames else (CHOSEN_KEYFRAME,)
        self.view_options.handles["follow"].visible = hello.has_frames
        self.clear_notices()

    def show_recording(self, hello: m.Hello) -> None:
        """Offer the recordings that can be mapped, if there are several, and show which one is."""
        if hello.recordings:
            names, place = hello.recordings, hello.recording
            change(self.recording, options=names, value=names[place], visible=True)

    def show_history(self, can_undo: bool, can_redo: bool) -> None:
        """Offer to take edits back, and to make them again, if there are any."""
        offered = zip(HISTORY_BUTTONS, (can_undo, can_redo), strict=True)
        names = tuple(name for name, can in offered if can)
        change(self._history, visible=bool(names), options=names or self._history.options)

    def set_following(self, on: bool | None = None) -> None:
        """Set the box that follows the camera; None turns it over."""
        box = self.view_options.handles["follow"]
        box.value = (not box.value) if on is None else on

    def show_in_photo_colors(self) -> None:
        """Show the colours that cameras saw, unless a user has chosen others than the first ones."""
        now, first = self.view_options.value(), ViewOptions()
        if (now.draw_as, now.color_by) == (first.draw_as, first.color_by):
            self.view_options.handles["color_by"].value = "photo"

    def show_lack_of_surface(self, why: str) -> None:
        """While there is no surface, offer voxels alone, in the colours that they have in its place, with a
        tooltip that says ``why``; if that is empty, show again what was chosen before."""
        drawn, colors = (self.view_options.handles[name] for name in ("draw_as", "color_by"))
        had, has, self._no_surface = not self._no_surface, not why, why
        said = f"The map is drawn as voxels. There is no surface: {why}."
        change(drawn, hint=field_help(ViewOptions)["draw_as"] if has else said)
        if had and not has:
            first, self._chosen = ViewOptions(), (drawn.value, colors.value)
            drawn.options = ("voxels",)
            if self._chosen == (first.draw_as, first.color_by):
                colors.value = GROWING
        elif has and not had:
            drawn.options, drawn.value = get_args(Draw), self._chosen[0]
            if colors.value == GROWING:
                colors.value = self._chosen[1]

    def show_status(self, status: m.Status) -> None:
        """Show progress and figures."""
        h, activity, past_s = self._hello, status.activity, self.time.past_s
        moving = not (status.paused or status.finished)
        if h.has_surface:
            past = "" if past_s is None else "it is made of the map of now, and this is an earlier time"
            later = "it is made at the end, or while paused" if moving or not status.voxels else ""
            both = self.view_options.handles["baseline"].value
            alike = "the baseline has none, and both maps are drawn alike" if both else ""
            self.show_lack_of_surface(status.no_surface or past or later or alike)
        if status.voxels:
            self.offer_colorings(h, status.layers)
        coming = h.has_frames and not status.finished  # else there is nothing to play
        run = (RUN_BUTTONS[status.paused], *RUN_BUTTONS[2:]) if coming else RUN_BUTTONS[-1:]
        change(self._run, options=run)
        if past_s is not None and status.finished and status.share >= 1.0:
            activity = f"showing the map as of {past_s:.1f} s"
        if not (status.voxels or self._names):
            ended = h.has_frames and not coming
            activity += "; no frame became a keyframe" if ended else "; it is empty until the first keyframe"
        self.show_activity(activity, status.share, moving)
        self._show_speed(status.speed)
        self._voxels, self._colored = status.voxels, COLORS in status.layers
        self._numbers.content = rows_html(
            {
                "source": h.source,
                **({"located": h.located} if h.located else {}),
                "method": h.method,
                "backend": f"{h.backend} ({h.device})",
                "voxel size": f"{100 * h.voxel_size:g} cm",
                "frames": f"{status.frame} of {status.frames}" if status.frames else f"{status.frame}",
                **({"sensor": status.arrivals} if status.arrivals else {}),
                "keyframes": f"{status.keyframes} ({status.frozen} frozen)",
                **({"keyframes per second": f"{status.keyframes_per_second:.1f}"} if moving else {}),
                "voxels": f"{status.voxels:,} in {status.bricks:,} bricks",
                "memory of the map": f"{status.memory_mb:,.0f} MB",
                "edits": "inference is not finished" if status.pending else "all in the map",
                "free space": status.free_space or "not calibrated",
            }
        )

    def show_counts(self, counts: Mapping[str, int], square_m: float | None, recording: bool) -> None:
        """Also show about how large the files are, and whether the next press ends a recording."""
        super().show_counts(counts, square_m, recording)
        sizes = {
            "Map": self._voxels * VOXEL_BYTES + self._rays * (COLORED_BYTES if self._colored else RAY_BYTES),
            "Voxels": counts.get("voxels", 0) * POINT_BYTES,
            "Mesh": counts.get("triangles", 0) * TRIANGLE_BYTES,
        }
        said = ", ".join(f"{name} {max(size / 1e6, 0.1):.2g} MB" for name, size in sizes.items() if size)
        self._size.content = f"About: {said}." if said else ""
        change(self._save[RECORD], label=f"Stop and save: {RECORD}" if recording else RECORD)

    def _show_speed(self, factor: float | None) -> None:
        """Set the dropdown to the speed in force, also one that only the command line offers."""
        change(self.speed, visible=factor is not None)
        if factor is not None:
            name = next((name for name, each in SPEEDS.items() if each == factor), f"{factor:g}x")
            change(self.speed, options=tuple(dict.fromkeys([*SPEEDS, name])), value=name)

    def show_keyframes(self, keyframes: dict[int, m.KeyframeInfo], chosen: int | None) -> None:
        """List the keyframes and show the chosen one. A frozen keyframe cannot be changed, so its widgets
        are disabled or hidden."""
        listed = [keyframes[id] for id in sorted(keyframes)]
        self._rays = sum(each.rays for each in listed)
        self._names = {
            f"{each.id}: {each.name} ({'earlier, ' * each.earlier}{each.state})": each.id for each in listed
        }
        self.keyframe.options = list(self._names) or [NO_KEYFRAME]
        before, self._all = self._all, (float(min(keyframes, default=0)), float(max(keyframes, default=0)))
        if self.range.value == before:  # as long as nobody has chosen another
            self.range.value = self._all
        names = (name for name, id in self._names.items() if id == chosen)
        self.keyframe.value = next(names, self.keyframe.options[0])
        fixed = chosen is None or keyframes[chosen].state == "frozen"
        for widget in (self.position, self.pixel, self._pixel_button):
            change(widget, disabled=fixed)
        change(self._edits, visible=not fixed)  # viser cannot disable a row of buttons
        change(self._thumbnail, visible=chosen is not None)
        if chosen is None:
            self._keyframe_text.content = ""
            return
        info = keyframes[chosen]
        if info.picture is not self._thumbnail_of:
            self._thumbnail_of = self._thumbnail.image = info.picture
        self.position.value = tuple(np.round(info.T_world_camera[:3, 3], 4).tolist())
        text = f"{info.rays:,} measured pixels"
        self._keyframe_text.content = in_markdown(f"{text}; frozen: it cannot be changed" if fixed else text)

    def chosen_keyframe(self) -> int | None:
        """The keyframe that is selected in the dropdown."""
        return self._names.get(self.keyframe.value)

    def show_images(self, images: m.Images | None) -> None:
        """Show the images of one view; None hides them when they are not updated any more."""
        for name, picture in self._pictures.items():
            if images is not None:
                picture.image = getattr(images, name)
            picture.visible = images is not None
        title, score = ("", "") if images is None else (images.title, images.score)
        now = "" if self.time.past_s is None else "\n\nof the map as it is now"
        self._score.content = f"**{in_markdown(title)}**\n\n{in_markdown(score)}{now}" if title else ""

    def _keyframe_tab(self) -> None:
        gui = self.gui
        hint = "The keyframe that the buttons change. Its frustum is magenta."
        self.keyframe = self.watch(gui.add_dropdown("Keyframe", [NO_KEYFRAME], hint=hint))
        self._edits: Any = self.add_buttons("Edit", EDIT_BUTTONS)
        hint = "Position of the keyframe's camera in the world; type another one to move the keyframe."
        self.position = self.watch(
            gui.add_vector3("Position (m)", (0.0, 0.0, 0.0), step=POSITION_STEP_M, hint=hint)
        )
        self._keyframe_text = gui.add_markdown("")
        self._thumbnail = gui.add_image(np.zeros((2, 2, 3), np.uint8), visible=False)
        hint = "Numbers of the first and the last keyframe that the buttons below switch; at first all."
        self.range: Any = gui.add_vector2("From, to", self._all, min=(0.0, 0.0), step=1.0, hint=hint)
        hint = "Remove all these keyframes from the map, or add them again; Undo takes that back at once."
        self.add_buttons("Several", ("All off", "All on"), hint)
        gui.add_markdown(
            "**On/off** removes the keyframe from the map, or adds it again. **Freeze** asks, and then makes "
            "its evidence permanent and drops its image. **Move** shows a gizmo: drag it, and the map "
            "follows when you let go. **Put back** returns the keyframe to its recorded pose."
        )

    def _ray_tab(self, scene: viser.SceneApi) -> None:
        self.pixel: Any = self.gui.add_vector2(
            "Pixel (u, v)", (0.0, 0.0), step=1.0, hint="Column and row in the image of the chosen keyframe."
        )
        hint = "Show what the ray of this pixel of the chosen keyframe passes through."
        self._pixel_button: Any = self.add_button("Show the ray", hint)
        self.ray = RayPlot(self.gui, scene)

    def _images_tab(self) -> None:
        gui = self.gui
        box = gui.add_checkbox("Show images", False, hint="Keep them up to date while mapping.")
        self.images = self.watch(box)
        self.view = self.watch(gui.add_dropdown("Images of", [CURRENT_CAMERA, CHOSEN_KEYFRAME]))
        self._score = gui.add_markdown("")
        labels = {
            "measured": "measured depth",
            "rendered": "depth rendered from the map",
            "accuracy": "accuracy: right (blue), wrong (orange), no surface (light), not judged (dark)",
        }
        black = np.zeros((2, 2, 3), np.uint8)
        self._pictures = {n: gui.add_image(black, label=label, visible=False) for n, label in labels.items()}
