"""The answer to a click on a voxel, in a panel beside it; and the distance from the click before."""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import LOG_ODDS_STEP, Hello, KeyframeInfo
from taichi_mrf.viewer.scene.base_panel import BasePanel, rows_html
from taichi_mrf.viewer.scene.voxel_store import VoxelStore

Point = tuple[float, float, float]
Vote = tuple[KeyframeInfo, float]
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
        with self._panel.add_tab("Voxel", viser.Icon.CUBE):
            self._text = panel.gui.add_html("")
            hint = "Remove this keyframe from the map."
            self._switches = [panel.add_button("", hint, action, visible=False) for action in SWITCHES]
            panel.add_button("Close", color="gray")
        self.said_by: list[int] = []
        """The keyframes that are listed."""

    def move(self, point: Point, place: tuple[float, float]) -> None:
        """Go to a voxel, show the panel at a ``place`` in the window (pixels), and draw a line from the voxel
        before."""
        before, self.point = self.point, point
        self._panel.float(x=place[0], y=place[1], width=_WIDTH_PX)
        self._panel.visible = True
        if before is not None and before != point:
            ends = np.array([before, point])
            self._apart = {"from the last click": f"{np.linalg.norm(ends[1] - ends[0]):.2f} m"}
            self._scene.add_line_segments(
                "/distance",
                ends[None].astype(np.float32),
                _LINE_COLOR,
                thickness=2.0,
                thickness_units="screen",
            )

    def show(self, facts: dict[str, str], votes: Sequence[Vote] = (), known: bool | None = None) -> None:
        """Show the facts of the voxel, and which keyframes say that it is occupied or free, the strongest
        first, each with a button; ``known`` is None before they have been asked."""
        self._scene.add_label("/answer", facts["state"], position=np.array(self.point))
        text = "asking the keyframes …" if known is None else "this map does not know which keyframes see it"
        if known:
            seen_by = f"{len(votes)} keyframes see it" if len(votes) > 1 else "one keyframe sees it"
            text = f"{seen_by}; alone each would say:" if votes else "no keyframe that is on sees it"
        self._text.content = (
            f'{rows_html(facts | self._apart)}<p style="margin:0.3em 1.25em;font-size:0.85em">{text}</p>'
        )
        self.said_by = [keyframe.id for keyframe, _ in votes[: len(SWITCHES)]]
        for i, button in enumerate(self._switches):
            button.visible = i < len(self.said_by)
            if button.visible:
                button.label = f"Switch off {votes[i][0].name}: {in_words(votes[i][1])}"

    def clear(self) -> None:
        """Hide the answer, and remove the line from the scene."""
        self.point, self._apart, self.said_by, self._panel.visible = None, {}, [], False
        for name in ("/answer", "/distance"):
            self._scene.remove_by_name(name)


def beside(x: float, y: float, width: int, height: int) -> tuple[float, float]:
    """The panel's upper left corner, in pixels: beside a click at (x, y) in a window of this size, towards
    its middle, as far as it fits in."""
    left = x + _ASIDE_PX if x < 0.45 * width else x - _ASIDE_PX - _WIDTH_PX
    return max(left, 0.0), max(min(y, height - _HEIGHT_PX), 0.0)


def in_words(log_odds: float) -> str:
    """What a keyframe alone would say of a voxel."""
    sure = 1 / (1 + np.exp(-abs(log_odds)))
    return f"{'occupied' if log_odds > 0 else 'free'}, {100 * sure:.0f}%"


def facts_of(point: NDArray[np.float64], store: VoxelStore, hello: Hello) -> dict[str, str]:
    """Coordinates, state, probability and colour of the voxel at a point (3,) in metres, as shown."""
    facts = {"x, y, z (m)": ", ".join(f"{value:.2f}" for value in point)}
    found = store.voxel(np.floor(point / hello.voxel_size).astype(np.int64))
    if found is None:
        return facts | {"state": "unknown"}
    log_odds = found[0] * LOG_ODDS_STEP
    known = abs(log_odds - hello.prior_log_odds) >= hello.min_evidence
    facts["state"] = "unknown" if not known else "occupied" if log_odds >= 0 else "free"
    facts["probability"] = f"{1 / (1 + np.exp(-log_odds)):.3f}"
    if found[1] is not None:
        facts["colour (RGB)"] = ", ".join(str(part) for part in found[1].tolist())
    return facts
