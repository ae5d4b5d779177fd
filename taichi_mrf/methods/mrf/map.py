"""MRFMap (Shankar & Michael, RSS 2020): keyframes in, marginal probabilities of occupancy out.

The computation itself is in inference/sum_product.py. This class is the map's interface; it is composed of
parts (parts.py), and of functions that work on them, whose modules are loaded on first use.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, PoseConfig, SensorConfig, VolumeConfig
from taichi_mrf.config.sections import InferenceConfig, TimeConfig
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.messages import count_observations, messages_at
from taichi_mrf.inference.prior import log_odds_without_bricks, prior_probability
from taichi_mrf.inference.ray_model import Limits
from taichi_mrf.inference.schedule import InferReport, InferSteps, Progress, content_key, driven
from taichi_mrf.methods.brick_map import BrickMap, own_parameters, own_section
from taichi_mrf.methods.mrf import inferring
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.methods.mrf.pixel_layer import PixelLayer
from taichi_mrf.methods.mrf.plug import METHOD
from taichi_mrf.methods.protocol import MapStatistics
from taichi_mrf.queries.survey import Occlusion, doubting
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.system.later import later
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology

if TYPE_CHECKING:
    from taichi_mrf.factor_graph import depth_graph
    from taichi_mrf.methods import map_file
    from taichi_mrf.methods.mrf import moved_evidence, moving_window, posed, reading, storage, surfacing
    from taichi_mrf.queries import change
    from taichi_mrf.queries.measured_depth import MeasuredDepth
else:
    moved_evidence, moving_window, posed, reading, storage, surfacing = later(
        "taichi_mrf.methods.mrf",
        "moved_evidence", "moving_window", "posed", "reading", "storage", "surfacing",
    )  # fmt: skip
    (depth_graph,) = later("taichi_mrf.factor_graph", "depth_graph")
    (map_file,) = later("taichi_mrf.methods", "map_file")
    (change,) = later("taichi_mrf.queries", "change")

DOUBT_FREE = 0.01
"""Lower bound on a voxel's probability where measurements are predicted, as a share of its prior: poses and
noise are never quite right. By default that is 0.02 surfaces per metre."""

DOUBT_OCCUPIED = 0.01
"""Chance that a predicted ray passes an occupied voxel, however often it was observed."""


class MRFMap(BrickMap):
    """A probabilistic occupancy map of any set of depth keyframes.

    Keyframes can be added, removed, moved and frozen in any order; after :meth:`infer` the map depends only
    on the final set. Until then, queries return the previous results.
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
        self._next_id = 0
        parts = (self.config, self.prior, self.view, self._registry, self.LIMITS, inferring.restore_messages)
        self._parts = MapParts.of(*parts)
        self._keyframes = self._parts.keyframes
        window_m = config.volume.window_m
        self.window = moving_window.MovingWindow(window_m, self._parts) if window_m > 0 else None

    @property
    def stale(self) -> bool:
        """Always False: changes take effect at once."""
        return False

    @property
    def settled(self) -> bool:
        """True from a complete :meth:`infer` with the configured sweeps until a keyframe changes."""
        return self._parts.settled

    @property
    def keyframes(self) -> Mapping[int, Keyframe]:
        """The keyframes that can still be moved and removed, by id."""
        return MappingProxyType(self._keyframes)

    @property
    def frozen(self) -> Mapping[int, str]:
        """Names of the keyframes that have been frozen, by id."""
        return MappingProxyType(self._parts.frozen)

    def _place_keyframe(
        self, name: str, T_world_camera: Pose, stamp_s: float, depth_m: ArrayLike, camera: Camera, **own: Any
    ) -> None:
        # Step 1, intake: axial depth d_r of each pixel, checked and with its noise on the device.
        image = self._parts.image(self.noise, depth_m, camera, **own)
        # Step 2, rays: which are cast and which bricks they cross (section IV-B). Steps 3 to 6 are infer's.
        keyframe = self._parts.allocator.place(self._next_id, name, image, T_world_camera, stamp_s)
        self._keyframes[keyframe.id] = keyframe
        self._parts.settled = False

    def remove_keyframe(self, id: int) -> None:
        """Remove a keyframe, its messages, and the bricks that no other one owns. Raises KeyframeError."""
        keyframe = self._parts.find(id)
        inferring.restore_messages(self._parts)
        self._parts.allocator.take_out(keyframe)
        inferring.drop(self._parts, id)

    def move_keyframe(
        self, id: int, T_world_camera: ArrayLike, pose_covariance: ArrayLike | None = None
    ) -> None:
        """Move a keyframe to another pose, (4, 4), as a SLAM back-end does. Its messages are dropped.

        ``pose_covariance`` (6, 6) is that of the new pose, as in :meth:`add_keyframe`, zeros if it is exact.
        Without it, the keyframe keeps its covariance. Raises KeyframeError, or CapacityError if there is not
        enough memory; the map is then unchanged.
        """
        posed.move_keyframe(self._parts, id, T_world_camera, pose_covariance)

    def update_poses(
        self,
        poses: Mapping[int, ArrayLike],
        least: float = 0.1,
        tolerance: float | None = None,
        seconds: float | None = None,
        covariances: Mapping[int, ArrayLike] | None = None,
    ) -> "posed.PoseUpdate":
        """Apply a corrected trajectory, as after a loop closure: poses, id -> (4, 4). ``covariances``, id ->
        (6, 6), are those of some of these poses, as :meth:`move_keyframe` takes them.

        1. Keyframes whose view moves by more than half a voxel are withdrawn: their messages belong to wrong
        places and no longer count.
        2. One by one, all are moved and swept at their new poses. The next one is always that whose viewpoint
        is furthest from those already in place, so that a few soon cover the map.
        3. Stale keyframes are swept again, as by :meth:`renew`; ``tolerance`` is passed to it.

        A keyframe stays where it is if nothing in its view would move by more than ``least`` voxels, unless
        it is given another covariance; the pose at which it was placed still counts.

        After ``seconds`` no further keyframe is started, but at least one is moved: pass ``left`` of the
        result to the next call. Until then those of ``left`` that were withdrawn have no evidence in the map,
        unless :meth:`infer`, or :meth:`renew` with their ids, sweeps them at their old poses. With ``least``
        0, :meth:`infer` afterwards gives the same map as one built from scratch with these poses, bit for
        bit, even if this call was interrupted and the poses are given again. Raises KeyframeError for an
        unknown id or an impossible pose, before anything moves, and CapacityError if there is not enough
        memory for a keyframe's new pose; it and those after it are then as if they were ``left``.
        """
        return posed.update_poses(self._parts, poses, least, tolerance, seconds, covariances or {})

    def renew(
        self,
        keyframes: Iterable[int] = (),
        tolerance: float | None = None,
        seconds: float | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Update the marginals incrementally. Sweeps ``keyframes`` (ids) first, then those whose cavity
        changed, most changed first, until each has had at most the share ``tolerance`` of its voxels'
        marginals moved since its last sweep (default: ``inference.renew_tolerance``).

        Starts no sweep after ``seconds``; the next call continues. The report's ``residual`` is the largest
        share left, its ``sweeps`` count keyframes. The result depends slightly on the order of changes;
        that of :meth:`infer` does not.
        """
        return posed.renew(self._parts, keyframes, tolerance, seconds, progress)

    def refine_pose(
        self, id: int, config: PoseConfig | None = None, guesses: Sequence[ArrayLike] = ()
    ) -> "posed.RefinedPose":
        """Move a keyframe to the nearby pose at which its depth is most likely given the map of the others.
        The search starts at its pose or at one of ``guesses``, (4, 4) each. Raises KeyframeError."""
        return posed.refine_pose(self._parts, id, config, guesses)

    def depth_log_likelihood(self, id: int) -> float:
        """Mean log-likelihood, per metre, of a keyframe's depth given the map of all others; NaN if it has
        none. Raises KeyframeError."""
        return posed.depth_log_likelihood(self._parts, id)

    @cached_property
    def aligner(self) -> "posed.Aligner":
        """Aligner of the keyframes with their measured surface."""
        return posed.aligner_of(self._parts)

    def freeze_keyframe(self, id: int) -> None:
        """Add a keyframe's messages to the evidence that inference starts from, and drop its image.

        A frozen keyframe can be neither moved nor removed, and costs neither time nor memory. In bricks that
        are not allocated yet, only free space is kept.
        """
        inferring.freeze_keyframe(self._parts, id)

    def take_in(self, other: "MRFMap", T_map_other: ArrayLike) -> None:
        """Add the evidence of another map's frozen keyframes, as if they had been frozen here
        (methods.mrf.moved_evidence). ``T_map_other`` (4, 4) transforms the other world to this map's. The
        evidence takes part in the next :meth:`infer`. Colours and surface measurements are not transferred,
        so the map then has no measured surface.

        Raises ConfigError if the voxels of the maps are not of one size, if evidence in one of them has dates
        (``time.half_life_s``) or if parts of the other lie on disk, and CapacityError if there is not enough
        memory.
        """
        moved_evidence.check(self.config, other.config, other.window, "the other map")
        T, free = as_pose(T_map_other), -self.LIMITS.message
        moved_evidence.add_moved(self._parts, other._parts, free, T, self._next_id)
        self._next_id += len(other.frozen)
        self.config = self._parts.config = replace(self.config, keep_surface=False)

    def infer(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Compute the marginals by loopy belief propagation.

        Without ``keyframes`` it starts without messages and sweeps all keyframes in an order determined by
        their content, so the map is a function of the set of keyframes. With ``keyframes`` (ids) it starts
        from the current messages and sweeps only those. ``sweeps`` overrides the configuration for this call.
        Inference ends early once a sweep has changed at most the share ``tolerance`` of the voxels seen by
        more than 0.01. ``progress`` is called after each keyframe; returning False stops. Raises ConfigError
        for an impossible argument, KeyframeError for an unknown id.
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
        return inferring.infer_steps(self._parts, sweeps, tolerance, keyframes)

    def checkpoint(self) -> inferring.Checkpoint:
        """State from which :meth:`restore` undoes a full :meth:`infer` stopped by ``progress``."""
        return inferring.take_checkpoint(self._parts)

    def restore(self, checkpoint: inferring.Checkpoint) -> None:
        """Return to a checkpoint. Only :meth:`infer` may have been called since."""
        inferring.go_back(self._parts, checkpoint)

    def showing(self, checkpoint: inferring.Checkpoint) -> AbstractContextManager[None]:
        """Within the block, all queries and files show the map as it was at a checkpoint: its states, ray
        casts, layers, surface and colours. The block must not change the map. Only :meth:`infer_steps` may
        have been started since the checkpoint."""
        return inferring.showing(self._parts, checkpoint)

    def factor_graph(self, every: int = 1, memory_limit_gb: float = 0.0) -> "depth_graph.FactorGraph":
        """The factor graph without average messages, for factor_graph.solve: a factor for the ray of every
        ``every``-th pixel in both directions, and one for each voxel's prior; its cells are the pool's
        voxels. Raises CapacityError, which names its size, if there is not enough memory."""
        keyframes = sorted(self._keyframes.values(), key=content_key)
        for keyframe in keyframes:
            self._parts.allocator.refresh(keyframe)
        parts = (self.sensor, self.config.inference, self.config.volume)
        return depth_graph.depth_graph(keyframes, self._pool, self.voxel_size, *parts, every, memory_limit_gb)

    def adopt(self, log_odds: NDArray[np.float32]) -> None:
        """Use these log-odds, (cells,) of :meth:`factor_graph`, as beliefs until the next infer."""
        inferring.adopt(self._parts, log_odds)

    def crossed_bricks(self, id: int) -> NDArray[np.int32]:
        """The bricks that a keyframe's rays cross, (n, 3), whether they are allocated or not."""
        footprint = self._parts.find(id).footprint
        return footprint.window.bricks_of(footprint.crossed)

    def seen_by(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Number of keyframes that observe each voxel of some bricks of the pool, (n,) slots -> (n, 512). All
        frozen ones count as one; 255 means 255 or more."""
        inferring.restore_messages(self._parts)
        sent = [(k.visible, k.messages) for k in self._keyframes.values() if k.messages is not None]
        return count_observations(slots, sent, self._pool)

    def votes_at(self, point: ArrayLike) -> dict[int, float]:
        """Each keyframe's vote on the voxel at a point (3,) in metres, by id: the log-odds that it adds to
        the others', above 0 for occupied. Frozen keyframes and those without evidence are left out."""
        inferring.restore_messages(self._parts)
        slots, numbers = self._registry.places_of(np.reshape(point, (1, 3)))
        sent = [(id, k.visible, k.messages) for id, k in self._keyframes.items() if k.messages is not None]
        slot, voxel = int(slots[0]), int(numbers[0])
        return messages_at(slot, voxel, sent, self._pool) if slot >= 0 else {}

    @property
    def last_voxel_steps(self) -> int:
        """Voxels that the rays of the last swept keyframe crossed, summed over its rays."""
        return self._parts.sweeper.voxel_steps

    def statistics(self) -> MapStatistics:
        """The size of the map."""
        return self._parts.statistics()

    @property
    def pixel_layers(self) -> Mapping[str, PixelLayer]:
        """The voxel layers computed from pixels, by name (voxels/layers.py). A pixel's evidence is divided
        among the voxels on its ray by the probability that it saw them, as of the last :meth:`infer`."""
        return MappingProxyType(self._parts.layers)

    @property
    def keeps_surface(self) -> bool:
        """True if frozen keyframes' surface measurements are kept."""
        return self._parts.kept.wanted

    @property
    def has_surface(self) -> bool:
        """True if the surface can be made from all keyframes: none is frozen, or the measurements of frozen
        ones are kept (``keep_surface``)."""
        return self._parts.has_surface

    def surface_field(self, between: Callable[[], object] = lambda: None) -> DistanceField:
        """The signed distances that the keyframes measured, as of the last :meth:`infer`, read-only: computed
        once for each state of the map. ``between`` is called after each keyframe. Raises CapacityError."""
        return surfacing.surface_field(self._parts, between)

    def surface(self, between: Callable[[], object] = lambda: None) -> "surfacing.FusedSurface":
        """The surface that the keyframes measured, by marching cubes through the mean of their signed
        distances: vertices, triangles, normals, and for each vertex a standard deviation in metres, and its
        colour if keyframes have colour images.

        It is made from the keyframes' images and the current marginals, so call :meth:`infer` first.
        Frozen keyframes have no images, and count only with ``keep_surface``. ``between`` is called many
        times a second; an exception from it ends the work. Raises ConfigError for a map without keyframes,
        CapacityError if there is not enough memory.
        """
        return surfacing.map_surface(self, self._parts, between)

    def _measured_surface(self) -> "MeasuredDepth | None":
        return surfacing.rendered(self, self._parts) if self.has_surface else None

    @property
    def now_s(self) -> float:
        """The time of the map in seconds: the newest keyframe's stamp; NaN without keyframes."""
        return self._parts.now_s

    def at(self, stamp_s: float) -> "reading.MapReading":
        """The map by its marginals as of a time in seconds, from the keyframes up to then. Frozen keyframes
        count from the time of the newest one on. Messages are the current ones, which also depend on later
        keyframes. Raises ConfigError in a map of a static world (``time.half_life_s`` is 0).
        """
        return self.layer("both", stamp_s)

    @property
    def static(self) -> "reading.MapReading":
        """The static layer: the map without the objects that appeared after their surroundings were mapped.
        Raises ConfigError in a map of a static world."""
        return self.layer("static")

    @property
    def dynamic(self) -> "reading.MapReading":
        """The dynamic layer: voxels that are occupied now, but free according to all keyframes together, with
        no surface nearby. All others are unknown. Raises ConfigError in a map of a static world."""
        return self.layer("dynamic")

    def layer(self, which: "reading.Layer" = "both", stamp_s: float | None = None) -> "reading.MapReading":
        """A layer of the map for queries and exports: "static", "dynamic", or "both" (the whole map), as of
        ``stamp_s`` in seconds, now if None.

        Raises ConfigError for another name. A map of a static world has only "both", and only now.
        """
        return reading.layer(self, self._parts, which, stamp_s)

    @property
    def decided(self) -> "reading.MapReading":
        """The map with a decided state for each voxel, for ray casts, pictures and exports; :meth:`state`,
        :meth:`occupancy` and :meth:`voxels` use it.

        Voxels are occupied if their marginal is over one half, or if they win the vote of the rays: each
        measured ray votes for its most likely first surface, and against the voxels in front of it
        (inference.surface_votes). Log-odds are the calibrated ones (:meth:`calibrated`) as far as the states
        allow, if the map is settled and has a surface; otherwise the marginals', with those of winners raised
        to just above even odds. Frozen keyframes vote only with ``keep_surface``.
        """
        return self.decide()

    def decide(self, between: Callable[[], object] = lambda: None) -> "reading.MapReading":
        """Compute :attr:`decided`, with ``between`` as in :meth:`surface`. Raises CapacityError."""
        return reading.decide(self, self._parts, between)

    @property
    def marginals(self) -> "reading.MapReading":
        """The map by the marginals of belief propagation alone, for queries and exports."""
        return reading.MapReading(self, self._parts, self._pool.belief)

    def calibrated(self, between: Callable[[], object] = lambda: None) -> "reading.MapReading":
        """The map of calibrated probabilities that voxels hold a surface, from the distances of all rays
        (methods.mrf.calibrated); the marginals are more cautious. Computed once for each state of the map.
        ``between`` is called after each keyframe. Raises CapacityError if there is not enough memory."""
        return reading.calibrated(self, self._parts, between)

    def _likely_grid(self) -> tuple[float, Topology, BrickPool, float]:
        """The calibrated log-odds where distances are available, else the marginals."""
        return self.decided._grid() if self.has_surface else self._grid()

    def first_surfaces(self) -> NDArray[np.uint8]:
        """The rays' verdict on voxels of ``view.pool`` beyond marginals, (slots, 512) (voxels/calls.py)."""
        return self._parts.decisions.calls(self.settled)

    def changes(self, since_s: float) -> "change.MapChange":
        """Difference between the map as of a time in seconds and now: ``appeared`` are voxels that were free
        and are occupied, ``vanished`` the reverse; ``points``, ``before`` and ``after`` list all voxels whose
        state has changed, newly seen ones included. Raises ConfigError in a map of a static world."""
        return change.compare_maps(self.at(since_s), self.marginals)

    def save(self, path: str | Path) -> None:
        """Write the map to one .npz file, under a temporary name first. Raises MapFileError."""
        storage.save(self, self._parts, self._next_id, Path(path), self.window)

    @classmethod
    def load(cls, path: str | Path, memory_limit_gb: float | None = None) -> "MRFMap":
        """Read a saved map, which can be queried at once and extended. ``memory_limit_gb`` overrides the
        saved limit. Raises MapFileError, or CapacityError if there is not enough memory."""
        return cls.holding(storage.read_contents(Path(path)), Path(path), memory_limit_gb)

    @classmethod
    def holding(cls, found: "storage.MapContents", path: Path, limit_gb: float | None = None) -> "MRFMap":
        """The map with these contents of a file, as :meth:`load`."""
        with map_file.naming(path):
            m = cls.with_noise(found.header.limited_to(limit_gb), found.header.noise)
            slots = storage.place_contents(found, m._parts)
            if m.window is not None:
                m.window.resume(path, found.parked)
        storage.show_contents(found, m._parts, slots)
        m._next_id, m._up, m.promise = found.header.next_id, found.header.up, found.header.promise
        return m
