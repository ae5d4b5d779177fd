"""Common base of all maps: the configuration, the bricks, and the answers to queries.

A method adds how keyframes change the voxels. Each voxel holds one number, its log-odds of being occupied,
in a pool of bricks that a registry allocates.
"""

import dataclasses
import weakref
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import instance, iterable, real, seconds, whole
from taichi_mrf.config.method import Method
from taichi_mrf.config.registry import methods_with
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.config.values import overridden
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.geometry.up import Up, up_of
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.methods.sensor_section import describing
from taichi_mrf.queries.points import classify, point_log_odds, probability
from taichi_mrf.queries.survey import Occlusion
from taichi_mrf.queries.view import Answer, RayProfile, View
from taichi_mrf.queries.voxel_map import PixelReader, VoxelMap
from taichi_mrf.sensor.camera import Camera, check_camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise, noise_from_config
from taichi_mrf.sensor.own_evidence import NOTHING, OwnEvidence
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.later import later
from taichi_mrf.system.owner import Owned, owned_attribute
from taichi_mrf.voxels.distance_field import DistanceSource
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology, create_topology, recycle

if TYPE_CHECKING:
    from taichi_mrf.queries import contradiction, extract, free, within
    from taichi_mrf.queries.measured_depth import MeasuredDepth
else:
    contradiction, extract, free, within = later(
        "taichi_mrf.queries", "contradiction", "extract", "free", "within"
    )

MapT = TypeVar("MapT", bound="BrickMap")
SectionT = TypeVar("SectionT")


def own_parameters(
    voxel_size: float,
    volume: VolumeConfig | None,
    min_depth: float,
    max_depth: float,
    time: TimeConfig | None,
) -> dict[str, Any]:
    """The arguments that the constructors of all methods share, checked, as fields of Config."""
    sensor = SensorConfig(min_depth=real(min_depth, "min_depth"), max_depth=real(max_depth, "max_depth"))
    volume = instance(volume or VolumeConfig(), VolumeConfig, "volume", "of type VolumeConfig")
    time = instance(time or TimeConfig(), TimeConfig, "time", "of type TimeConfig")
    return {"voxel_size": real(voxel_size, "voxel_size"), "sensor": sensor, "volume": volume, "time": time}


def own_section(
    given: Any, cls: type[SectionT], parameters: dict[str, Any], name: str, where: str
) -> SectionT:
    """A method's section of the configuration, ``given`` or the default, with some parameters replaced."""
    section = instance(cls() if given is None else given, cls, name, f"of type {cls.__name__}")
    return overridden(section, parameters, where)


def check_inference(
    sweeps: int | None, tolerance: float | None, keyframes: Iterable[int] | None
) -> list[int] | None:
    """Check the arguments of ``infer``; returns ``keyframes`` as a list without repetitions."""
    if sweeps is not None:
        whole(sweeps, "sweeps")
    if tolerance is not None:
        real(tolerance, "tolerance", least=0)
    if keyframes is None:
        return None
    return list(dict.fromkeys(iterable(keyframes, "keyframes", "a list of keyframe ids")))


class BrickMap(PixelReader, Owned):
    """An empty map of bricks that answers queries; each method subclasses it and fills it in its own way.

    ``config`` is the whole configuration of the map; ``view`` casts rays through it.
    """

    METHOD: ClassVar[Method]
    """The entry of the map's method."""

    view: View = owned_attribute()

    promise: "free.FreePromise | None" = None
    """Bounds for the levels of free space in this map, from frames that it has not seen
    (evaluation.free_space.calibrate_free); ``taichi-mrf map`` sets them. None: the default table."""

    window: Any = None
    """Keeps only a part of an MRFMap in memory (moving_window.MovingWindow); None if all of it stays."""

    _next_id: int
    """The id of the next keyframe: how many were added."""

    seen_free_log_odds: float
    """Log-odds of a place that rays cross but that has no brick."""

    def _make_bricks(
        self,
        config: Config,
        noise: NoiseModel | None,
        prior_log_odds: float,
        seen_free_log_odds: float,
        shown: VolumeConfig,
        occlusion: Occlusion,
        predicting: Occlusion | None = None,
    ) -> None:
        """Set the configuration and the noise, and make the empty grid. ``shown``, ``occlusion`` and
        ``predicting`` are the View's."""
        if noise is not None:
            instance(noise, NoiseModel, "noise", "a noise model such as PolynomialNoise")
        runtime.init()
        self.sensor = describing(noise, config.sensor)
        self.config = dataclasses.replace(config, method=self.METHOD.name, sensor=self.sensor)
        self.voxel_size = config.voxel_size
        self.noise = noise if noise is not None else PolynomialNoise(self.sensor.sigma, self.sensor.bias)
        self._pool = BrickPool(prior_log_odds, config.volume.memory_limit_gb)
        topology = create_topology(runtime.active() or "cpu", config.volume.dense_bricks)
        weakref.finalize(self, recycle, topology)
        self._registry = BrickRegistry(topology, self._pool, self.voxel_size)
        self.seen_free_log_odds = seen_free_log_odds
        self._up: Up | None = None
        self.view = View(self._pool, self.voxel_size, shown, occlusion, predicting)

    @classmethod
    def from_config(cls: type[MapT], config: Config, camera: Camera) -> MapT:
        """A map with a configuration's parameters, whose noise tables must fit ``camera``."""
        instance(config, Config, "config", "a Config")
        check_camera(camera)
        return cls.with_noise(config, noise_from_config(config.sensor, camera))

    @classmethod
    def with_noise(cls: type[MapT], config: Config, noise: NoiseModel) -> MapT:
        """A map with a configuration's parameters, except for its noise, which is given."""
        m = cls.__new__(cls)
        m._set_up(config, noise)
        return m

    @property
    def up(self) -> Up | None:
        """The world axis that is up in the image of the first keyframe ever added; None before it."""
        return self._up

    if TYPE_CHECKING:  # each method has its own

        def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
            """Make the empty map of a whole configuration, which describes the noise unless it is given.
            Every constructor ends here; subclasses extend it."""

        def _place_keyframe(
            self, name: str, T_world_camera: Pose, stamp_s: float, depth_m: ArrayLike, camera: Camera,
            **own: Any,
        ) -> None:  # fmt: skip
            """Keep keyframe number ``_next_id``; ``own`` are the arguments of :meth:`add_keyframe` from
            ``color`` on, unchecked. If it raises, the map is as before."""

    def add(self, frame: Frame) -> int:
        """Add a frame, as read by :func:`open_dataset`, as a keyframe; returns its id. The configuration
        decides whether the frame's noise and missing returns are used, and the method whether its images are.
        The first frame sets the map's origin in the recorded world. Raises the errors of ``add_keyframe``,
        and ConfigError for a frame with another origin."""
        config = _at_origin_of(frame, self.config, is_empty=self.up is None)
        color, images = (frame.color, frame.images) if self.METHOD.has_colors else (None, {})
        own = dataclasses.replace(frame.own_in(config), images=images)
        parts = (frame.T_world_camera, frame.camera, frame.name, frame.stamp, color)
        id = self.add_keyframe(frame.depth_m, *parts, **own.arguments())
        self.config = config  # not before the frame is in
        return id

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
        images: Mapping[str, ArrayLike] | None = None,
    ) -> int:
        """Add a depth image; returns its id. In an MRFMap it takes part in the next :meth:`infer`; maps of
        other methods integrate it at once unless they are :attr:`stale`.

        ``depth_m`` is (H, W) axial depth in metres, where 0, NaN and negative mean no measurement;
        ``T_world_camera`` is (4, 4); ``stamp_s`` is its time in seconds, by default the number of keyframes
        added before; ``color`` is (H, W, 3) uint8 RGB of the same pixels, 0 0 0 for none, from which
        :meth:`colors` follow; ``noise`` is its own noise model; ``sigma_m`` is (H, W), the standard deviation
        of each pixel's depth in metres, in place of the noise model's: 0, negative and NaN stand for the
        model's, and an infinite one means no measurement; ``no_return`` is (H, W), the pixels without a
        return: bool, used according to ``sensor.no_return`` by the methods that can, or float32, the depth up
        to which each is free (own_evidence.NoReturn); ``pose_covariance`` is (6, 6), the covariance of the
        pose error xi in the camera frame (metres, then radians) where the true pose is T_world_camera
        exp(xi), None for an exact pose (sensor/pose_doubt.py); ``images`` are further images beside depth, by
        name, for layers of voxels (voxels/layers.py). Raises KeyframeError for a wrong shape or pose and for
        an invalid covariance, CapacityError if the map would not fit into memory, ConfigError for wrong
        noise, and for images of which the method has no layer.
        """
        T, name = as_pose(T_world_camera), instance(name, str, "name", "a string")
        stamp_s = float(self._next_id) if stamp_s is None else seconds(stamp_s, "stamp_s")
        self._place_keyframe(
            name or f"keyframe {self._next_id}", T, stamp_s, depth_m, camera, color=color, noise=noise,
            sigma_m=sigma_m, no_return=no_return, pose_covariance=pose_covariance, images=images,
        )  # fmt: skip
        if self._up is None:
            self._up = up_of(T, camera.up)
        self._next_id += 1
        if self.window is not None:
            self.window.follow(self, T[:3, 3])
        return self._next_id - 1

    @tensors.in_kind("points", on_device=True)
    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        """Probability of occupied at (N, 3) points in metres, (N,) float32, that of :attr:`decided`; the
        prior where nothing was measured."""
        return probability(self.decided._log_odds(points))

    @property
    def decided(self) -> Any:
        """The map whose log-odds decide which voxels are occupied: this one, unless the method overrides
        it."""
        return self

    @property
    def marginals(self) -> Any:
        """The map by its own log-odds alone: this one, unless the method overrides it."""
        return self

    @tensors.in_kind("points", on_device=True)
    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        """UNKNOWN, FREE or OCCUPIED at (N, 3) points in metres, (N,) int8."""
        log_odds = self.decided._log_odds(points)
        return classify(log_odds, self._pool.prior_log_odds, self.view.volume.min_evidence)

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """All allocated voxels of at least this probability, that of :attr:`decided`: centres (N, 3) in
        metres, and (N,)."""
        least, pool = real(min_probability, "min_probability"), self.decided._pool
        return extract.extract_voxels(pool, self.voxel_size, least)

    @tensors.in_kind("T_world_camera")
    def render_depth(
        self, camera: Camera, T_world_camera: ArrayLike, by: Answer = "surface"
    ) -> NDArray[np.float32]:
        """Axial depth of each pixel's most likely surface, (H, W) float32, NaN where there is none.

        A ray ends on the surface that keyframes measured if that lies near the ray's likeliest voxel
        (queries.measured_depth). Elsewhere, and in maps without such a surface, it ends at the centre of that
        voxel, if it is more likely to be stopped than to pass.
        ``by="omega"`` ignores the measured surface, as in the paper (eq. 18)."""
        check_camera(camera)
        T = as_pose(T_world_camera)
        likeliest_m, stopped = self.view.likeliest_depth(camera, T, self.sensor.max_depth)
        depth_m = np.where(stopped, likeliest_m, np.float32(np.nan))
        if by == "omega":
            return depth_m
        near_m = self.measured_depth(likeliest_m, camera, T)
        return np.where(np.isnan(near_m), depth_m, near_m)

    @tensors.in_kind("likeliest_m", "T_world_camera")
    def measured_depth(
        self, likeliest_m: NDArray[np.float32], camera: Camera, T_world_camera: ArrayLike
    ) -> NDArray[np.float32]:
        """Axial depth (H, W) of the measured surface where it is near the likeliest voxels, whose depths are
        ``likeliest_m`` (H, W); NaN elsewhere, and everywhere in maps without such a surface."""
        measured = self._measured_surface()
        if measured is None:
            return np.full(camera.shape, np.nan, np.float32)
        return measured.near(likeliest_m, camera, as_pose(T_world_camera), self.sensor.max_depth)

    def _measured_surface(self) -> "MeasuredDepth | None":
        """The surface that keyframes measured, for ray casts; None in maps without one."""
        return None

    @property
    def has_surface(self) -> bool:
        """True if the map holds the surface measured by all its keyframes."""
        return False

    def surface(self) -> Any:
        """The surface that keyframes measured. Raises ConfigError in a map without one."""
        raise ConfigError(
            f"a map of the method {self.METHOD.name} does not measure surfaces: "
            f"{methods_with('measures_surface')} does"
        )

    def surface_field(self) -> DistanceSource:
        """The signed distances that keyframes measured. Raises ConfigError in a map without them."""
        raise ConfigError(f"a map of the method {self.METHOD.name} does not measure surfaces")

    @tensors.in_kind("origin", "direction")
    def ray_profile(
        self, origin: ArrayLike, direction: ArrayLike, max_range: float | None = None
    ) -> RayProfile:
        """Occupancy, visibility and omega (MRFMap, eqs. 15 to 18) along a ray, by range in metres, up to
        ``max_range`` (``sensor.max_depth`` by default)."""
        if max_range is not None:
            real(max_range, "max_range", above=0)
        return self.view.ray_profile(origin, direction, max_range or self.sensor.max_depth)

    @tensors.in_kind("depth_m", "T_world_camera")
    def ray_scores(
        self: VoxelMap,
        depth_m: ArrayLike,
        T_world_camera: ArrayLike,
        camera: Camera,
        own: OwnEvidence = NOTHING,
    ) -> NDArray[np.float32]:
        """Contradiction between the map and each pixel of a depth image that is not in it, (H, W) float32 in
        nats: above 0 something new, below 0 a vanished surface (queries.contradiction.ray_scores)."""
        return contradiction.ray_scores(self, depth_m, T_world_camera, camera, own)

    @tensors.in_kind("points")
    def occupied_within(self, points: ArrayLike, radius_m: float) -> NDArray[np.float32]:
        """The probability that something lies within ``radius_m`` metres of points (N, 3) in metres, (N,)
        float32 (queries.within). Raises ConfigError, CapacityError if the points lie too far apart."""
        return within.occupied_within(points, radius_m, *self._likely_grid())

    @tensors.in_kind("points")
    def path_collision(self, points: ArrayLike, radius_m: float) -> NDArray[np.float32]:
        """The probability that a ball of ``radius_m`` metres collides on its way from point to point: a path
        (N, 3) in metres -> (), paths (P, N, 3) -> (P,) (queries.within). Raises as :meth:`occupied_within`,
        and ConfigError for a path without points."""
        return within.path_collision(points, radius_m, *self._likely_grid())

    @tensors.in_kind("points")
    def free_with(self, points: ArrayLike, level: float = 0.99, radius_m: float = 0.0) -> NDArray[np.bool_]:
        """True for points (N, 3) in metres, or balls of ``radius_m`` around them, that are free at a level:
        at most 1 - ``level`` of such voxels contain matter. (N,) bool. A ball is free if all voxels that it
        overlaps are free (queries.free).

        The level's bound is that of :attr:`promise`. Raises ConfigError for a level that cannot be promised,
        and in a map that is not :attr:`settled`: its probabilities are not the calibrated ones."""
        return free.free_with(self, points, level, radius_m)

    @tensors.in_kind("points")
    def path_free_with(self, points: ArrayLike, radius_m: float, level: float = 0.99) -> NDArray[np.bool_]:
        """True if all voxels that a ball overlaps along a path (N, 3) -> (), or paths (P, N, 3) -> (P,), are
        free at a level; otherwise as :meth:`free_with`."""
        return free.path_free_with(self, points, radius_m, level)

    def box_free_with(self, lower: ArrayLike, upper: ArrayLike, level: float = 0.99) -> bool:
        """True if all voxels of an upright box between two corners, (3,) in metres, are free at a level;
        otherwise as :meth:`free_with`."""
        return free.box_free_with(self, lower, upper, level)

    def _log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        return point_log_odds(points, *self._grid())

    def _grid(self) -> tuple[float, Topology, BrickPool, float]:
        """The voxels as queries at points take them."""
        return self.voxel_size, self._registry.topology, self._pool, self.seen_free_log_odds

    def _likely_grid(self) -> tuple[float, Topology, BrickPool, float]:
        """The voxels as queries take them, with the probabilities that can be trusted most."""
        return self._grid()


def _at_origin_of(frame: Frame, config: Config, is_empty: bool) -> Config:
    """A map's configuration with the origin of a frame that is to be added. Raises ConfigError if the map
    has another already."""
    origin = config.volume.origin
    if frame.origin_m is None or frame.origin_m == origin:
        return config
    if not is_empty or any(origin):
        theirs, own = (" ".join(f"{x:.0f}" for x in place) for place in (frame.origin_m, origin))
        raise ConfigError(f"frame {frame.name}: its world's origin is {theirs}, the map's is {own}")
    x, y, z = frame.origin_m
    return dataclasses.replace(config, volume=dataclasses.replace(config.volume, origin=(x, y, z)))
