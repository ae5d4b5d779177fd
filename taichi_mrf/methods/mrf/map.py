"""MRFMap (Shankar & Michael, RSS 2020): keyframes in, marginal probabilities of occupancy out.

The class manages keyframes, bricks and messages. The computation itself is inference/sum_product.py.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.alignment.keyframe_surfels import KeyframeSurfels
from taichi_mrf.alignment.refine import Aligner
from taichi_mrf.config.arguments import instance
from taichi_mrf.config.inference import InferenceConfig
from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.errors import KeyframeError
from taichi_mrf.factor_graph.depth_graph import depth_graph
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.geometry.poses import as_pose
from taichi_mrf.inference.incremental import IncrementalInference
from taichi_mrf.inference.keyframe import DepthImage, Keyframe, checked_color, checked_depth
from taichi_mrf.inference.keyframe_bounds import KeyframeBounds
from taichi_mrf.inference.prior import log_odds_without_bricks, prior_probability
from taichi_mrf.inference.ray_list import RayBundler
from taichi_mrf.inference.ray_model import Limits
from taichi_mrf.inference.schedule import InferReport, InferSteps, Progress, content_key, driven, sweep_steps
from taichi_mrf.inference.sweep import Sweeper, unknown_entry_depths
from taichi_mrf.methods.brick_map import check_inference, own_parameters, own_section
from taichi_mrf.methods.map_file import MapHeader, StoredKeyframe, naming
from taichi_mrf.methods.mrf.checkpoint import Checkpoint, go_back, take_checkpoint
from taichi_mrf.methods.mrf.coloring import MapColors
from taichi_mrf.methods.mrf.decided import Decisions
from taichi_mrf.methods.mrf.kept_rays import KeptRays
from taichi_mrf.methods.mrf.keyframe_allocator import KeyframeAllocator
from taichi_mrf.methods.mrf.memory_budget import MemoryBudget
from taichi_mrf.methods.mrf.moving_window import MovingWindow
from taichi_mrf.methods.mrf.plug import METHOD
from taichi_mrf.methods.mrf.posed import PosedMRF
from taichi_mrf.methods.mrf.storage import contents_of, read_contents, write_contents
from taichi_mrf.queries.occlusion import Occlusion, doubting
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel, warn_of_bad_sigma
from taichi_mrf.sensor.own_evidence import checked_evidence, checked_no_return
from taichi_mrf.voxels.layout import VOXELS

DOUBT_FREE = 0.01
"""Lower bound on a voxel's probability where measurements are predicted, as a share of its prior: poses and
noise are never quite right. By default that is 0.02 surfaces per metre."""

DOUBT_OCCUPIED = 0.01
"""Chance that a predicted ray passes a voxel that was seen to be occupied, however often."""


class MRFMap(PosedMRF):
    """A probabilistic occupancy map of any set of depth keyframes.

    Keyframes can be added, removed, moved and frozen in any order; after :meth:`infer` the map depends only
    on the final set. Until then, queries return what was computed before.
    """

    METHOD: ClassVar[Method] = METHOD
    LIMITS: ClassVar[Limits] = Limits()
    """Comparisons with exact inference have their own."""

    def __init__(
        self,
        voxel_size: float = 0.05,
        noise: NoiseModel | None = None,
        *,
        inference: InferenceConfig | None = None,
        volume: VolumeConfig | None = None,
        time: TimeConfig | None = None,
        min_depth: float = SensorConfig.min_depth,
        max_depth: float = SensorConfig.max_depth,
        keep_surface: bool = False,
        **parameters: Any,
    ) -> None:
        """``parameters`` are fields of InferenceConfig, such as ``surface_density=2.1`` or ``prior=0.1``.

        ``noise`` defaults to a Kinect 1; for ``keep_surface`` see :meth:`surface`. Raises ConfigError for an
        unknown or impossible parameter.
        """
        section = own_section(inference, InferenceConfig, parameters, "inference", "MRFMap")
        shared = own_parameters(voxel_size, volume, min_depth, max_depth, time)
        self._set_up(Config(**shared, inference=section, keep_surface=keep_surface), noise)

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        inference = config.inference
        self.prior = prior_probability(inference, config.voxel_size)
        log_odds = log_odds_without_bricks(inference, config.voxel_size, self.LIMITS.message)
        doubt = doubting(DOUBT_FREE, DOUBT_OCCUPIED, self.prior)
        self._make_bricks(config, noise, *log_odds, config.volume, Occlusion(), doubt)
        bundler = RayBundler(self.voxel_size, inference)
        bounds = KeyframeBounds()
        parts = (self.sensor, self.config.volume, self.LIMITS.precision)
        self._keyframes: dict[int, Keyframe] = {}
        self._date(config.time)
        budget = MemoryBudget(self._pool, self.LIMITS.precision)
        self._allocator = KeyframeAllocator(self._registry, bundler, *parts, bounds, budget, self._dated)
        self._sweeper = Sweeper(self.voxel_size, self.sensor, inference, self.config.volume, self.LIMITS)
        note_sweep = None if self._dated is None else self._dated.note_sweep
        kept = (bounds, self._allocator.look_again, self._allocator.refresh, inference.renew_tolerance)
        self._incremental = IncrementalInference(self._pool, self._sweeper, *kept, note_sweep)
        self.aligner = Aligner(self.view, KeyframeSurfels(self.voxel_size, self.sensor.max_depth))
        self._frozen: dict[int, str] = {}
        self._next_id = 0
        self._messages_lost = False  # a loaded map has beliefs, but no messages
        self._settled = True
        self._colors = MapColors(self._registry, self._keyframes, self._sweeper, self._allocator.refresh)
        self._kept = KeptRays(config.keep_surface)
        self._decisions = Decisions(self._registry, self._keyframes, self._kept, self._sweeper)
        parked = (self._registry, self._dated, self.aligner.surface, self._colors, self._kept)
        self.window = MovingWindow.of(self.config.volume, *parked)

    @property
    def stale(self) -> bool:
        """Always False: changes show at once."""
        return False

    @property
    def settled(self) -> bool:
        """True if the marginals are those of a full :meth:`infer` with the configured sweeps: it was not
        stopped, and no keyframe changed since."""
        return self._settled

    def add_keyframe(
        self,
        depth_m: ArrayLike,
        T_world_camera: ArrayLike,
        camera: Camera,
        name: str = "",
        stamp_s: float | None = None,
        color: ArrayLike | None = None,
        noise: NoiseModel | None = None,
        sigma_m: ArrayLike | None = None,
        no_return: ArrayLike | None = None,
        pose_covariance: ArrayLike | None = None,
    ) -> int:
        """Add a depth image. It takes part in the next :meth:`infer`.

        ``depth_m`` is (H, W) axial depth in metres, where 0, NaN and negative mean no measurement;
        ``T_world_camera`` is (4, 4); ``stamp_s`` is when it was taken, in seconds, by default the number of
        keyframes added before; ``color`` is (H, W, 3) uint8 RGB of the same pixels, 0 0 0 for none, from
        which :meth:`colors` follow; ``noise`` is its own noise model; ``sigma_m`` is (H, W), the standard
        deviation of each pixel's depth in metres, in place of the noise model's: 0, negative and NaN stand
        for the model's, and an infinite one means no measurement; ``no_return`` is (H, W) bool, the pixels
        that got no return, which count as ``sensor.no_return`` says; ``pose_covariance`` is (6, 6), that of
        the twist xi, metres along and then radians about the camera's own axes, by which the true pose
        T_world_camera exp(xi) may differ, None for an exact pose (sensor/pose_doubt.py). Returns the id.
        Raises KeyframeError for a wrong shape or pose and for a matrix that is no covariance, CapacityError
        if the map would not fit, ConfigError for noise that does not fit the camera.
        """
        T, stamp_s = as_pose(T_world_camera), self._stamp(stamp_s)
        name = instance(name, str, "name", "a string") or f"keyframe {self._next_id}"
        image = self._upload(depth_m, camera, color, noise, sigma_m, no_return, pose_covariance)
        keyframe = self._allocator.place(self._next_id, name, image, T, stamp_s)
        self._keyframes[keyframe.id] = keyframe
        self._note_up(T, camera)
        self._next_id += 1
        self._settled = False
        if self.window is not None:
            self.window.follow(self, T[:3, 3])
        return keyframe.id

    def remove_keyframe(self, id: int) -> None:
        """Remove a keyframe, its messages, and every brick that no other keyframe owns. Raises
        KeyframeError."""
        keyframe = self._find(id)
        self._restore_messages()
        self._allocator.take_out(keyframe)
        del self._keyframes[id]
        self._settled = False

    def freeze_keyframe(self, id: int) -> None:
        """Add a keyframe's messages to the evidence that inference starts from, and drop its image.

        A frozen keyframe can be neither moved nor removed, and costs neither time nor memory. Of bricks that
        are not allocated yet, only that it saw them to be free is kept.
        """
        keyframe = self._find(id)
        self._restore_messages()
        if keyframe.messages is None:
            raise KeyframeError(
                f"keyframe {id} ({keyframe.name}) has no messages to freeze: call infer first"
            )
        self._keep_share(keyframe)
        self._allocator.freeze(keyframe)
        self.aligner.surface.freeze(keyframe)
        self._decisions.frozen(id)
        self._frozen[id] = keyframe.name
        del self._keyframes[id]
        self._settled = False

    def infer(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Compute the marginals by loopy belief propagation.

        Without ``keyframes`` it starts without messages and sweeps all keyframes in an order that follows
        from their content, so the map is a function of the set of keyframes. With ``keyframes`` (ids) it
        starts from the present messages and sweeps only those. ``sweeps`` overrides the configuration for
        this call. Inference ends early once a sweep has changed at most the share ``tolerance`` of the voxels
        seen by more than 0.01. ``progress`` is called after each keyframe; returning False stops. Raises
        ConfigError for an impossible argument, KeyframeError for an unknown id.
        """
        return driven(self.infer_steps(sweeps, tolerance, keyframes), progress)

    def infer_steps(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
    ) -> InferSteps:
        """:meth:`infer` as a generator, which yields an InferProgress after each keyframe. Between two steps
        the map may be queried but not changed."""
        chosen_ids = check_inference(sweeps, tolerance, keyframes)
        configured = self.config.inference.sweeps
        sweeps, tolerance = configured if sweeps is None else sweeps, tolerance or 0.0
        if chosen_ids is None:
            chosen = sorted(self._keyframes.values(), key=content_key)
            self._pool.restart()
            for keyframe in chosen:
                # Entry depths of earlier sweeps would change the rounding of rays, so they start over too.
                keyframe.entry_depths = unknown_entry_depths(keyframe.ray_list)
                keyframe.entry_depths_known = False
                keyframe.messages = None
                self._allocator.refresh(keyframe)
            self._messages_lost = False
        else:
            chosen = [self._find(id) for id in chosen_ids]
            self._restore_messages()
            for keyframe in chosen:
                self._allocator.refresh(keyframe)
        for keyframe in chosen:
            self._pool.touch(keyframe.visible.slots)
        as_configured = keyframes is None and (sweeps, tolerance) == (configured, 0.0)
        complete = False
        try:
            note = None if self._dated is None or chosen_ids is None else self._dated.note_sweep
            report = yield from sweep_steps(chosen, self._pool, self._sweeper, sweeps, tolerance, note)
            complete = report.complete
        finally:
            self._settled = complete and as_configured
            if self._dated is not None and chosen_ids is None:
                self._dated.outdate()
        return report

    def factor_graph(self, every: int = 1, memory_limit_gb: float = 0.0) -> FactorGraph:
        """The factor graph without average messages, for factor_graph.solve: a factor for the ray of every
        ``every``-th pixel in both directions, and one for each voxel's prior; its cells are the pool's
        voxels. Raises CapacityError, which names its size, if there is not enough memory."""
        keyframes = sorted(self._keyframes.values(), key=content_key)
        for keyframe in keyframes:
            self._allocator.refresh(keyframe)
        parts = (self.sensor, self.config.inference, self.config.volume)
        return depth_graph(keyframes, self._pool, self.voxel_size, *parts, every, memory_limit_gb)

    def adopt(self, log_odds: NDArray[np.float32]) -> None:
        """Use these log-odds, (cells,) of :meth:`factor_graph`, as beliefs until the next infer."""
        self._pool.restart()
        for keyframe in self._keyframes.values():
            keyframe.messages = None
        self._allocator.mark_without_messages(self._keyframes.values())
        self._show(self._pool.in_use, log_odds.reshape(-1, VOXELS).astype(np.float32))
        self._messages_lost, self._settled = bool(self._keyframes), False

    def checkpoint(self) -> Checkpoint:
        """State that :meth:`restore` needs to undo a full :meth:`infer` that ``progress`` has stopped."""
        return take_checkpoint(self._pool, self._keyframes.values(), self._messages_lost, self._settled)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to a checkpoint. Since then only :meth:`infer` may have been called."""
        go_back(checkpoint, self._pool, self._keyframes.values())
        self._messages_lost, self._settled = checkpoint.messages_lost, checkpoint.settled
        self._allocator.mark_without_messages(self._keyframes.values())
        if self._dated is not None:
            self._dated.outdate()

    def save(self, path: str | Path) -> None:
        """Write the map to one .npz file, under a temporary name first. Raises MapFileError."""
        keyframes = list(self._keyframes.values())
        stored = [StoredKeyframe.of(keyframe) for keyframe in keyframes]
        header = MapHeader(self.config, self.noise, stored, self._next_id, self._settled, self.up)
        parked = () if self.window is None else self.window.save_beside(Path(path), self)
        parts = (self._frozen, parked, self._dated, self._colors, self._kept)
        write_contents(Path(path), contents_of(header, self._registry, keyframes, *parts))
        if self.window is not None:
            self.window.saved(Path(path))

    @classmethod
    def load(cls, path: str | Path, memory_limit_gb: float | None = None) -> "MRFMap":
        """Read a saved map, which can be queried at once and extended. ``memory_limit_gb`` overrides the
        saved limit. Raises MapFileError, or CapacityError if there is not enough memory."""
        contents = read_contents(Path(path))
        header, bricks = contents.header, contents.bricks
        with naming(Path(path)):
            m = cls.with_noise(header.limited_to(memory_limit_gb), header.noise)
            if len(bricks):
                slots = m._registry.restore(bricks, contents.frozen_owners)
            m._registry.see_for_good(contents.frozen_crossed)
            m._restore_shares(contents.frozen_colors, contents.kept)
            m._frozen = dict(contents.frozen)
            for k in header.keyframes:
                image = m._upload(k.depth_m, k.camera, k.color, **k.own.arguments())
                parts = (image, k.T_world_camera, k.stamp_s)
                m._keyframes[k.id] = m._allocator.place(k.id, k.name, *parts)
            if m.window is not None:
                m.window.resume(Path(path), contents.parked)
        if len(bricks):
            if contents.evidence is not None:
                m._pool.write("evidence", slots, contents.evidence)
            if m._dated is not None and contents.frozen_dated is not None:
                m._dated.restore_frozen(slots, *contents.frozen_dated)
            m._show(slots, contents.belief)
            if m._dated is not None and contents.total is not None:
                m._pool.write("total", slots, contents.total)
            m._colors.show(slots, contents.colors)
        m._next_id, m._up = header.next_id, header.up
        m._messages_lost, m._settled = bool(m._keyframes), header.settled
        return m

    def _upload(
        self, depth_m: ArrayLike, camera: Camera, color: ArrayLike | None,
        noise: NoiseModel | None, sigma_m: ArrayLike | None, no_return: ArrayLike | None,
        pose_covariance: ArrayLike | None,
    ) -> DepthImage:  # fmt: skip
        depth = checked_depth(depth_m, camera, self.sensor.min_depth)
        depth, own = checked_evidence(depth, camera, noise, sigma_m, pose_covariance)
        if self.sensor.no_return != "ignore":
            own = replace(own, no_return=checked_no_return(no_return, depth_m, camera))
        image = DepthImage.upload(depth, camera, self.noise, checked_color(color, camera), own)
        if not self._keyframes:
            warn_of_bad_sigma(image.noise_table, self.sensor.min_depth, self.sensor.max_depth)
        return image

    def _restore_messages(self) -> None:
        """Compute the messages of a loaded map: its file holds none, because they follow from the images."""
        if self._messages_lost:
            self.infer()
