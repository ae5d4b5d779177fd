"""The answer to a click on a voxel, or to a rectangle, in a panel beside it."""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.scene.base_panel import BasePanel, rows_html
from taichi_mrf.viewer.scene.keyframe_layer import draw_lines
from taichi_mrf.viewer.scene.viewpoint import PANEL_OF_WINDOW
from taichi_mrf.viewer.scene.voxel_store import VoxelStore

Point = tuple[float, float, float]
Vote = tuple[m.KeyframeInfo, float]
"""A keyframe, and the log-odds that it adds to a voxel."""

SWITCHES = tuple(f"switch off {place}" for place in range(5))
"""Actions of the buttons beside what keyframes say of a voxel, by their places in the list."""

_ASIDE_PX, _WIDTH_PX, _HEIGHT_PX = 65, 290, 430
"""Size of the panel with all buttons, and its distance from the voxel."""
_LINE_COLOR = (255, 255, 255)


class VoxelAnswer:
    """Owns a floating panel, and the scene nodes /answer, a label at the voxel, and /distance."""

    def __init__(self, scene: viser.SceneApi, panel: BasePanel) -> None:
        self._scene = scene
        self.point: Point | None = None
        """The voxel that is shown, in metres, world; None without one."""
        self._apart: dict[str, str] = {}
        self._panel = panel.gui.add_panel(visible=False)
        with self._panel.add_tab("Answer", viser.Icon.CUBE):
            self._text = panel.gui.add_html("")
            hint = "Remove this keyframe from the map; Undo brings it back."
            self._switches = [panel.add_button("", hint, action, visible=False) for action in SWITCHES]
            panel.add_button("Close", color="gray")
        self.said_by: list[int] = []
        """The keyframes that are listed."""

    def move(self, point: Point, place: tuple[float, float]) -> None:
        """Go to a voxel, show the panel at a ``place`` in the window (pixels), and a line from the last."""
        before, self.point = self.point, point
        self._panel.float(x=place[0], y=place[1], width=_WIDTH_PX)
        self._panel.visible = True
        self._panel.expand()
        if before is not None and before != point:
            ends = np.array([before, point])
            self._apart = {"from the last click": f"{np.linalg.norm(ends[1] - ends[0]):.2f} m"}
            draw_lines(self._scene, "/distance", ends[None], _LINE_COLOR)

    def show(self, facts: dict[str, str], votes: Sequence[Vote] = (), known: bool | None = None) -> None:
        """Show the facts of the voxel, and which keyframes say that it is occupied or free, the strongest
        first, each with a button; ``known`` is None before they have been asked."""
        label = facts.get("state") or f"{facts['voxels']} voxels"
        self._scene.add_label("/answer", label, position=np.array(self.point))
        text = "asking the keyframes …" if known is None else "this map does not know which keyframes see it"
        if known:
            several = f"{len(votes)} keyframes see this; alone each would say:"
            text = several if votes else "no keyframe that is on sees this"
            text = "one keyframe sees this; it says:" if len(votes) == 1 else text
        self._text.content = (
            f'{rows_html(facts | self._apart)}<p style="margin:0.3em 1.25em;font-size:0.85em">{text}</p>'
        )
        self.said_by = [keyframe.id for keyframe, _ in votes[: len(SWITCHES)]]
        for i, button in enumerate(self._switches):
            button.visible = i < len(self.said_by)
            if button.visible:
                button.label = f"{votes[i][0].name}: {in_words(votes[i][1])} · switch off"

    def clear(self) -> None:
        """Hide the answer, and remove the line from the scene."""
        self.point, self._apart, self.said_by, self._panel.visible = None, {}, [], False
        for name in ("/answer", "/distance"):
            self._scene.remove_by_name(name)


def beside(camera: viser.CameraHandle, share: ArrayLike) -> tuple[float, float]:
    """The panel's upper left corner, in pixels: beside a place (2,), in shares of a browser's window, or else
    at the edge, where it covers neither the place nor the middle of the map nor the page's own panel."""
    width, height = camera.image_width, camera.image_height
    x, y = (np.asarray(share) * (width, height)).tolist()
    most = width * (1 - PANEL_OF_WINDOW) - _WIDTH_PX
    beside = (x - _ASIDE_PX - _WIDTH_PX, x + _ASIDE_PX, 0.0, most)
    fits = [left for left in beside if 0 <= left <= most and not left < x < left + _WIDTH_PX]
    middle = 0.5 * width * (1 - PANEL_OF_WINDOW)
    free = [left for left in fits if not left < middle < left + _WIDTH_PX]
    return next(iter([*free, *fits]), 0.0), max(min(y, height - _HEIGHT_PX), 0.0)


def in_words(log_odds: float) -> str:
    """Verdict of a keyframe alone on a voxel."""
    sure = 1 / (1 + np.exp(-abs(log_odds)))
    return f"{'occupied' if log_odds > 0 else 'free'}, {100 * sure:.0f}%"


def facts_of_many(voxels: int, points: NDArray[np.float64]) -> dict[str, str]:
    """Number of some voxels, and middle and size of what is shown of them: points (n, 3) in metres."""
    low, high = points.min(axis=0), points.max(axis=0)
    return {
        "voxels": f"{voxels:,}",
        "middle x, y, z (m)": ", ".join(f"{value:.2f}" for value in (low + high) / 2),
        "size x, y, z (m)": " x ".join(f"{value:.2f}" for value in high - low),
    }


def facts_of(point: NDArray[np.float64], store: VoxelStore, hello: m.Hello) -> dict[str, str]:
    """Coordinates, state, probability and colour of the voxel at a point (3,) in metres, as shown."""
    facts = {"x, y, z (m)": ", ".join(f"{value:.2f}" for value in point)}
    found = store.voxel(np.floor(point / hello.voxel_size).astype(np.int64))
    if found is None:
        return facts | {"state": "unknown"}
    log_odds = found[0] * m.LOG_ODDS_STEP
    known = abs(log_odds - hello.prior_log_odds) >= hello.min_evidence
    facts["state"] = "unknown" if not known else "occupied" if log_odds >= 0 else "free"
    facts["probability"] = f"{1 / (1 + np.exp(-log_odds)):.3f}"
    if found[1] is not None:
        facts["colour (RGB)"] = ", ".join(str(part) for part in found[1].tolist())
    return facts
