"""The widgets of the live page, and where they stand. What they mean is decided in page.py."""

import html
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from taichi_mrf.viewer.events import Chosen, Event, OptionsMoved, Pressed
from taichi_mrf.viewer.live.options import ViewOptions
from taichi_mrf.viewer.messages import Hello, Images, KeyframeInfo, Notice, Status
from taichi_mrf.viewer.notices import notices_html
from taichi_mrf.viewer.scene.ray_plot import RayPlot
from taichi_mrf.viewer.widgets import OptionWidgets

RUN_BUTTONS = ("Go", "Pause", "Step", "Reset")
KEYFRAME_BUTTONS = ("On/off", "Freeze", "Move", "Put back")
SAVE_BUTTONS = {
    "Map": "The map with its keyframes: a .npz file that `taichi-mrf live` and `MRFMap.load` open.",
    "Voxels": "The voxels of at least one half as a .ply file, for MeshLab, CloudCompare or Blender.",
    "Picture": "What this browser shows, as a .png file.",
    "Page": "The scene as one .html file that any browser opens, without a server.",
    "Recording": "Start to record the scene; press again to get it as a .viser file.",
}
SPEEDS = {"as fast as it goes": 0.0, "0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0, "4x": 4.0}
CURRENT_CAMERA, CHOSEN_KEYFRAME = "current camera", "chosen keyframe"
NO_KEYFRAME = "none yet"
POSITION_STEP_M = 0.01

_MAP_OPTIONS = ("color_by", "threshold", "size", "shade", "cut_axis", "cut_at", "bricks", "beside")
_PAGE_OPTIONS = ("follow", "pictures", "dark")
_MOST_NOTICES = 6


class Panel:
    """Makes the widgets once; everything that a viewer does with them goes to ``tell``."""

    def __init__(self, gui: viser.GuiApi, scene: viser.SceneApi, tell: Callable[[Event], None]) -> None:
        self._gui, self._tell = gui, tell
        self._notices: list[Notice] = []
        self._names: dict[str, int] = {}
        self._activity = gui.add_markdown("Starting …")
        self._progress: Any = gui.add_progress_bar(0.0, animated=True)
        self._buttons(gui.add_button_group("Run", RUN_BUTTONS))
        self.speed: Any = gui.add_dropdown(
            "Speed", list(SPEEDS), hint="Replay the recording at a multiple of its own pace."
        )
        self.speed.on_update(lambda event: self._chosen(event, "speed"))
        self._legend = gui.add_html("")
        self._shown = gui.add_markdown("0 voxels shown")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Map", viser.Icon.CUBE):
            moved = lambda: tell(OptionsMoved())  # noqa: E731 - one word for both groups
            self._map_options = OptionWidgets(gui, ViewOptions(), moved, _MAP_OPTIONS)
            self._page_options = OptionWidgets(gui, ViewOptions(), moved, _PAGE_OPTIONS)
        with tabs.add_tab("Keyframes", viser.Icon.CAMERA):
            self._keyframe_tab()
        with tabs.add_tab("Ray", viser.Icon.CHART_LINE):
            self.pixel: Any = gui.add_vector2(
                "Pixel (u, v)", (0.0, 0.0), step=1.0, hint="Column and row in the chosen keyframe."
            )
            self._button("Ray of pixel", "Show the ray of this pixel of the chosen keyframe.")
            self.ray = RayPlot(gui, scene)
        with tabs.add_tab("Images", viser.Icon.PHOTO):
            self._images_tab()
        with tabs.add_tab("Save", viser.Icon.DOWNLOAD):
            for name, hint in SAVE_BUTTONS.items():
                self._button(name, hint)
        with tabs.add_tab("About", viser.Icon.INFO_CIRCLE):
            self._numbers = gui.add_html("")
            self._notice_list = gui.add_html("")
            self._parameters = gui.add_markdown("")

    def options(self) -> ViewOptions:
        """The view options as the widgets stand."""
        page, shown = self._page_options.value(), self._map_options.value()
        values = {name: getattr(page, name) for name in _PAGE_OPTIONS}
        values |= {name: getattr(shown, name) for name in _MAP_OPTIONS}
        return ViewOptions(**values)

    def show_hello(self, hello: Hello) -> None:
        """What is mapped, with what, and with which parameters."""
        self._hello = hello
        self._parameters.content = f"Parameters in force\n\n```yaml\n{hello.parameters}\n```"
        self._notices.clear()
        self._list_notices()

    def show_counts(self, voxels: int, beside: int, recording: bool) -> None:
        """How many voxels the page shows."""
        text = f"{voxels:,} voxels shown" + (f", {beside:,} beside (OctoMap's way)" if beside else "")
        self._shown.content = text + (" · recording" if recording else "")

    def show_status(self, status: Status) -> None:
        """How the work stands."""
        self._activity.content = _plain(status.activity)
        self._progress.value = 100.0 * min(max(status.share, 0.0), 1.0)
        self._progress.animated = not (status.paused or status.finished)
        self._show_speed(status.speed)
        h = self._hello
        rows = {
            "source": h.source,
            "method": h.method,
            "backend": f"{h.backend} ({h.device})",
            "voxel size": f"{100 * h.voxel_size:g} cm",
            "frames": f"{status.frame} of {status.frames}" if status.frames else f"{status.frame}",
            "keyframes": f"{status.keyframes} ({status.frozen} frozen)",
            "keyframes a second": f"{status.keyframes_per_second:.1f}",
            "voxels": f"{status.voxels:,} in {status.bricks:,} bricks",
            "memory of the map": f"{status.memory_mb:,.0f} MB",
            "edits": "not settled yet" if status.pending else "settled",
        }
        cells = "".join(
            f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in rows.items()
        )
        self._numbers.content = (
            f'<table style="margin:0 0.75em;font-size:0.85em;border-spacing:0.5em 0">{cells}</table>'
        )

    def _show_speed(self, factor: float) -> None:
        """Let the dropdown say which speed is in force, also one that only the command line offers."""
        name = next((name for name, each in SPEEDS.items() if each == factor), f"{factor:g}x")
        names = list(SPEEDS) if name in SPEEDS else [*SPEEDS, name]
        if list(self.speed.options) != names:
            self.speed.options = names
        if self.speed.value != name:
            self.speed.value = name

    def show_notice(self, notice: Notice) -> None:
        """Keep a sentence for the page, and let it pop up."""
        self._notices = [notice, *self._notices][:_MOST_NOTICES]
        self._list_notices()

    def show_legend(self, legend_html: str) -> None:
        """The scale of the colours."""
        self._legend.content = legend_html

    def show_keyframes(self, keyframes: dict[int, KeyframeInfo], chosen: int | None) -> None:
        """List the keyframes and what is chosen among them."""
        listed = [keyframes[id] for id in sorted(keyframes)]
        self._names = {f"{each.id}: {each.name} ({each.state})": each.id for each in listed}
        self.keyframe.options = list(self._names) or [NO_KEYFRAME]
        name = next((name for name, id in self._names.items() if id == chosen), None)
        self.keyframe.value = name or self.keyframe.options[0]
        if chosen is not None:
            position = keyframes[chosen].T_world_camera[:3, 3]
            self.position.value = tuple(np.round(position, 4).tolist())
            self._keyframe_text.content = _plain(f"{keyframes[chosen].rays:,} measured pixels")

    def chosen_keyframe(self) -> int | None:
        """The keyframe that the dropdown stands at."""
        return self._names.get(self.keyframe.value)

    def show_images(self, images: Images) -> None:
        """Put the pictures of one view beside the map."""
        self._measured.image, self._rendered.image = images.measured, images.rendered
        self._accuracy.image = images.accuracy
        for picture in (self._measured, self._rendered, self._accuracy):
            picture.visible = True
        self._score.content = f"**{_plain(images.title)}**\n\n{_plain(images.score)}"

    def hide_images(self) -> None:
        """Take the pictures away: they would go stale."""
        for picture in (self._measured, self._rendered, self._accuracy):
            picture.visible = False
        self._score.content = ""

    def _keyframe_tab(self) -> None:
        gui = self._gui
        self.keyframe: Any = gui.add_dropdown(
            "Keyframe", [NO_KEYFRAME], hint="The buttons act on this one. Its frustum is magenta."
        )
        self.keyframe.on_update(lambda event: self._chosen(event, "keyframe"))
        self._buttons(gui.add_button_group("Do", KEYFRAME_BUTTONS))
        self.position: Any = gui.add_vector3(
            "Position (m)",
            (0.0, 0.0, 0.0),
            step=POSITION_STEP_M,
            hint="Where its camera stands; change it to move it.",
        )
        self.position.on_update(lambda event: self._chosen(event, "position"))
        self._keyframe_text = gui.add_markdown("")
        gui.add_markdown(
            "**On/off** takes it out of the map or back in. **Freeze** folds it in for good. **Move** "
            "puts a gizmo on it: drag, let go, and the map follows."
        )

    def _images_tab(self) -> None:
        gui = self._gui
        self.images = gui.add_checkbox("Show images", False, hint="Keep them up to date while mapping.")
        self.images.on_update(lambda event: self._chosen(event, "images"))
        self.view = gui.add_dropdown("View", [CURRENT_CAMERA, CHOSEN_KEYFRAME])
        self.view.on_update(lambda event: self._chosen(event, "images"))
        self._score = gui.add_markdown("")
        black = np.zeros((2, 2, 3), np.uint8)
        self._measured = gui.add_image(black, label="measured depth", visible=False)
        self._rendered = gui.add_image(black, label="depth rendered from the map", visible=False)
        label = "accuracy: right (blue), wrong (orange), no answer (light), not judged (dark)"
        self._accuracy = gui.add_image(black, label=label, visible=False)

    def _button(self, name: str, hint: str) -> None:
        button = self._gui.add_button(name, hint=hint)
        button.on_click(lambda event: self._pressed(event, name))

    def _buttons(self, group: Any) -> None:
        group.on_click(lambda event: self._pressed(event, event.target.value))

    def _pressed(self, event: viser.GuiEvent, name: str) -> None:
        if event.client_id is not None:
            self._tell(Pressed(name, event.client_id))

    def _chosen(self, event: viser.GuiEvent, widget: str) -> None:
        if event.client_id is not None:  # not one of our own changes
            self._tell(Chosen(widget))

    def _list_notices(self) -> None:
        self._notice_list.content = notices_html(self._notices)


def _plain(text: str) -> str:
    """Text for a markdown widget, in which nothing is markup; names of frames may hold anything."""
    return "".join("\\" + c if c in "\\`*_{}[]<>#|!&" else c for c in text)
