"""Interface of a mapping system in the comparison, and its settings, from fast to thorough."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices (V, 3) in metres, triangles (T, 3)."""


@dataclass(frozen=True)
class Answers:
    """Predictions of a map for a held-out view: the axial depth of the first surface (H, W) in metres, NaN
    where there is none, and the mean log density of what was measured, in nats with metres."""

    depth_m: NDArray[np.floating]
    log_likelihood: float


@dataclass(frozen=True)
class Cells:
    """Of N points: the probability of occupied, and whether the map calls them occupied or free; neither is
    unknown. (N,) each."""

    probability: NDArray[np.floating]
    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]


class Peer(Protocol):
    """A map that takes frames one by one."""

    stages_ms: dict[str, float]
    """Processor time of all frames so far by stage, if the system tells; in milliseconds."""

    def integration(self, view: SceneView) -> Callable[[], object]:
        """Prepare a frame in the system's own form, which is not timed; calling the result maps it."""

    def conclude(self) -> None:
        """Do what is done once after the last frame; it is timed."""

    def answers(self, view: SceneView) -> Mapping[str, Answers]:
        """The prediction of a view, by the name of the reading of the map."""

    def cells(self, points_m: NDArray[np.float64]) -> Mapping[str, Cells]:
        """The state of points (N, 3) in metres, by the name of the reading."""

    def mesh(self) -> Mesh:
        """Its surface."""

    @property
    def memory_mb(self) -> float:
        """As the system itself counts its map."""


@dataclass(frozen=True)
class Knob:
    """One setting. ``stride``: one in so many rows and columns is used, of a lidar's beams one in the square
    of it. ``selected``: only keyframes are mapped. ``standard``: as its makers would run it."""

    name: str
    stride: int = 1
    parameters: Mapping[str, Any] = field(default_factory=dict)
    selected: bool = False
    standard: bool = False

    def of_keyframes(self) -> "Knob":
        """Copy of the setting, on keyframes alone."""
        return replace(self, name=f"{self.name}, keyframes", selected=True, standard=False)


@dataclass(frozen=True)
class System:
    """A system with its settings, from fast to thorough. ``images_only``: it takes images of a pinhole."""

    name: str
    make: Callable[[Scene, float, Knob], Peer]
    knobs: Sequence[Knob]
    images_only: bool = False


def thinned(view: SceneView, scene: Scene, stride: int) -> SceneView:
    """The view with every ``stride``-th row and column, and its camera."""
    camera = view.camera or scene.camera
    step = stride if camera.height > 1 else stride * stride
    part = (slice(None, None, step),) * 2
    return replace(
        view,
        measured_m=np.ascontiguousarray(view.measured_m[part]),
        true_m=np.ascontiguousarray(view.true_m[part]),
        judged=np.ascontiguousarray(view.judged[part]),
        camera=camera.thinned(step),
    )
