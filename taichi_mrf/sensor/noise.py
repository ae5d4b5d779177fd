"""Model of a sensor's error: bias and standard deviation as functions of axial depth.

``bias`` is the mean of measured minus true depth, ``sigma`` the standard deviation of the measured
depth; both are polynomials of the true axial depth in metres, for the whole image or for each square
patch of pixels (MRFMap, section IV-C).
"""

import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.errors import ConfigError, said
from taichi_mrf.sensor.camera import Camera, PinholeCamera, pinhole
from taichi_mrf.sensor.limits import LEAST_SIGMA_M, TERMS
from taichi_mrf.sensor.stored import Arrays, Stored, read_stored, stored_arrays
from taichi_mrf.system.later import later

if TYPE_CHECKING:
    from taichi_mrf.sensor.model import Sensor
    from taichi_mrf.system import npz_file
else:
    (npz_file,) = later("taichi_mrf.system", "npz_file")


UNBIASED_STEPS = 5
"""Fixed-point steps from a measurement to the depth that gives it. Where the bias changes by less than a
fifth of a metre in a metre, less than a thousandth of it is left."""

Curves = tuple[NDArray[np.float64], NDArray[np.float64]]
"""sigma (at least LEAST_SIGMA_M) and bias at depths (n,), a row for each kind of pixel."""


class CameraNoise(Protocol):
    """The noise of one camera's pixels, of any class; that of polynomials is NoiseTable."""

    def at_pixels(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """sigma (at least LEAST_SIGMA_M) and bias, (H, W) each, for surfaces at (H, W) axial depths."""

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The largest sigma and the largest absolute bias that any pixel has at each of some depths, (N,)."""

    def sensor(self, camera: Camera) -> "Sensor":
        """A camera with this noise as kernels take it."""


@dataclass(frozen=True)
class NoiseTable:
    """Noise in the form that kernels read: polynomials.

    ``coefficients`` is (patches, 2, TERMS) float32: sigma, then bias, ascending powers of axial depth.
    Pixel (u, v) belongs to patch (v // patch) * columns + u // patch.
    """

    coefficients: NDArray[np.float32]
    patch: int
    columns: int

    def at_pixels(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        v, u = np.ogrid[: depth_m.shape[0], : depth_m.shape[1]]
        row = (v // self.patch) * self.columns + u // self.patch if len(self.coefficients) > 1 else 0
        sigma, bias = (evaluate(self.coefficients[row, which], depth_m) for which in (0, 1))
        return np.maximum(sigma, LEAST_SIGMA_M), bias

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        values = np.abs(evaluate(self.coefficients[:, :, None], depth_m.reshape(1, 1, -1)))
        return np.maximum(values[:, 0], LEAST_SIGMA_M).max(axis=0), values[:, 1].max(axis=0)

    def sensor(self, camera: Camera) -> "Sensor":
        from taichi_mrf.sensor.model import Sensor
        from taichi_mrf.sensor.polynomials import PolynomialTable
        from taichi_mrf.system.resident import resident

        table = PolynomialTable(resident(self.coefficients), self.patch, self.columns)
        return Sensor(camera.in_kernels(), table)


@dataclass(frozen=True)
class ScaledNoiseTable:
    """The noise ``of`` pixels, whose sigma is multiplied by ``scale``, float32 (H, W), or (1, 1) for all of
    them, before ``added_m`` metres are added."""

    of: CameraNoise
    scale: NDArray[np.float32]
    added_m: float

    def at_pixels(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        sigma, bias = self.of.at_pixels(depth_m)
        return np.maximum(sigma * self.scale + self.added_m, LEAST_SIGMA_M), bias

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        sigma, bias = self.of.largest(depth_m)
        largest = sigma * float(self.scale.max(initial=1.0)) + self.added_m
        return np.maximum(largest, LEAST_SIGMA_M), bias

    def sensor(self, camera: Camera) -> "Sensor":
        from taichi_mrf.sensor.polynomials import ScaledTable
        from taichi_mrf.system.resident import resident

        sensor, patch = self.of.sensor(camera), 1 if self.scale.shape == camera.shape else max(camera.shape)
        parts = resident(self.scale.reshape(-1)), patch, self.scale.shape[1], self.added_m
        return replace(sensor, noise=ScaledTable(sensor.noise, *parts))


@runtime_checkable
class NoiseModel(Protocol):
    """Interface of a noise model, as MRFMap needs it."""

    def table(self, camera: Camera) -> CameraNoise:
        """The noise of one camera's pixels. Raises ConfigError if the model does not fit the camera."""


class StoredNoise(Stored):
    """The base of noise models that map files hold, and parameter files name (``sensor.sigma_table``)."""

    sigma: NDArray[np.float64]
    bias: NDArray[np.float64]

    @abstractmethod
    def table(self, camera: Camera) -> CameraNoise:
        """As NoiseModel has it."""

    def curves(self, depth_m: NDArray[np.float64]) -> Curves:
        """Curves for plots at depths (n,) in metres, here those of (patches, TERMS) coefficients."""
        return _curves(self.sigma, self.bias, depth_m)


class PolynomialNoise(StoredNoise):
    """One bias and sigma for every pixel, as polynomials of axial depth."""

    def __init__(self, sigma: Sequence[float], bias: Sequence[float] = (0.0,)) -> None:
        """Coefficients in ascending powers of depth; metres."""
        self.sigma = _padded(np.atleast_2d(array(sigma, "sigma")), "sigma")
        self.bias = _padded(np.atleast_2d(array(bias, "bias")), "bias")

    def table(self, camera: Camera) -> NoiseTable:
        """One patch that covers the image, whatever the camera."""
        return _table(self.sigma, self.bias, max(camera.width, camera.height), 1)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"sigma": self.sigma, "bias": self.bias}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "PolynomialNoise":
        return cls(*(file.array(name, "f", (1, None))[0] for name in ("sigma", "bias")))


class PatchNoise(StoredNoise):
    """Learnt bias and sigma for each square patch of pixels of one camera."""

    def __init__(self, sigma: ArrayLike, bias: ArrayLike, patch: int, camera: Camera) -> None:
        """``sigma`` and ``bias`` are (rows * columns, degree + 1), patches row by row, ``patch`` pixels
        wide and high (the last ones may hang over the image's edge).

        Raises ConfigError if the number of patches does not fit the camera.
        """
        self.sigma = _padded(array(sigma, "sigma"), "sigma")
        self.bias = _padded(array(bias, "bias"), "bias")
        if patch < 1:
            raise ConfigError(f"the noise tables' patch must be at least 1 pixel, not {patch}")
        self.patch = patch
        self.camera = camera
        self.columns = -(-camera.width // patch)
        patches = self.columns * -(-camera.height // patch)
        for name, rows in (("sigma", len(self.sigma)), ("bias", len(self.bias))):
            if rows != patches:
                raise ConfigError(
                    f"the {name} table has {rows} patches, but {camera.width} x {camera.height} pixels in "
                    f"patches of {patch} make {patches}"
                )

    @classmethod
    def load(cls, path: str | Path) -> "PatchNoise":
        """Read the ``noise.npz`` that ``taichi-mrf calibrate`` writes: ``sigma``, ``bias``, ``patch``, and
        ``camera`` (width, height, fx, fy, cx, cy). Raises ConfigError, which names the file.
        """
        found = load_noise(path)
        if not isinstance(found, cls):
            raise ConfigError(f"{path}: holds a {type(found).__name__}, not a {cls.__name__}")
        return found

    @classmethod
    def of_arrays(cls, file: Arrays) -> "PatchNoise":
        camera = PinholeCamera.of_row(file.array("camera", "fiu", (6,)))
        sigma, bias = (file.array(name, "fiu", (None, None)) for name in ("sigma", "bias"))
        return cls(sigma, bias, file.array("patch", "iu", ()).item(), camera)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays that :meth:`load` reads, by name. Raises ConfigError for a camera that is no pinhole."""
        camera = pinhole(self.camera, "a file of noise tables").row
        return {"sigma": self.sigma, "bias": self.bias, "patch": np.array(self.patch), "camera": camera}

    def table(self, camera: Camera) -> NoiseTable:
        if camera.shape != self.camera.shape:
            raise ConfigError(
                f"the noise table was learnt at {self.camera.width} x {self.camera.height} pixels, "
                f"not {camera.width} x {camera.height}"
            )
        return _table(self.sigma, self.bias, self.patch, self.columns)


class WidenedNoise(StoredNoise):
    """A noise model of any class with another sigma. ``law`` (2) holds metres that are added to the model's,
    and the factor on it."""

    def __init__(self, noise: NoiseModel, law: NDArray[np.float64]) -> None:
        self.noise, self.law = noise, law

    def table(self, camera: Camera) -> ScaledNoiseTable:
        added_m, scale = self.law.tolist()
        return ScaledNoiseTable(self.noise.table(camera), np.full((1, 1), scale, np.float32), added_m)

    def curves(self, depth_m: NDArray[np.float64]) -> Curves:
        sigma, bias = cast(StoredNoise, self.noise).curves(depth_m)
        return np.maximum(self.law[1] * sigma + self.law[0], LEAST_SIGMA_M), bias

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Its law, and the arrays of its model. Raises MapFileError if that cannot be saved."""
        return {"law": self.law, **stored_arrays(self.noise, "of_")}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "WidenedNoise":
        return cls(file.stored("of_"), file.array("law", "f", (2,)))


def load_noise(path: str | Path) -> StoredNoise:
    """The noise model of an .npz with its ``stored_arrays``. Raises ConfigError, which names the file."""
    with npz_file.open_npz(Path(path), ConfigError, "a readable noise table") as file:
        found = read_stored(file)
    if not isinstance(found, StoredNoise):
        raise ConfigError(f"{path}: holds a {type(found).__name__}, not a noise model")
    return found


def curves_of(config: SensorConfig) -> Callable[[NDArray[np.float64]], Curves]:
    """:meth:`StoredNoise.curves` of the noise that a configuration describes, whose files are read once.
    Raises ConfigError naming field and file."""
    if is_model(config.sigma_table):
        return _stored_model(config).curves
    sigma, bias = patch_coefficients(config)
    return lambda depth_m: _curves(sigma, bias, depth_m)


def is_model(table: str | None) -> bool:
    """True if ``sigma_table`` names the file of a whole noise model, not of polynomials."""
    return table is not None and Path(table).suffix == ".npz"


def _stored_model(config: SensorConfig) -> Any:
    if config.bias_table is not None:
        raise ConfigError(f"sensor.bias_table: leave it out, {config.sigma_table} holds a bias of its own")
    return widened_noise(load_noise(str(config.sigma_table)), config)


def noise_from_config(config: SensorConfig, camera: Camera) -> NoiseModel:
    """The noise model that a configuration describes. Raises ConfigError naming field and file."""
    if is_model(config.sigma_table):
        return _stored_model(config)
    sigma, bias = patch_coefficients(config)
    if config.sigma_table is None and config.bias_table is None:
        return PolynomialNoise(sigma[0].tolist(), bias[0].tolist())
    patches = -(-camera.width // config.patch) * -(-camera.height // config.patch)
    if config.sigma_table is None:
        sigma = np.repeat(sigma, patches, axis=0)
    if config.bias_table is None:
        bias = np.repeat(bias, patches, axis=0)
    try:
        return PatchNoise(sigma, bias, config.patch, camera)
    except ConfigError as error:
        files = [file for file in (config.sigma_table, config.bias_table) if file is not None]
        raise ConfigError(f"{' and '.join(files)}: {error}") from error


def patch_coefficients(config: SensorConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coefficients of sigma and of bias in ascending powers of depth: a row for each patch of the table that
    is in force, or one for the whole image. ``sigma_scale`` and ``sigma_added`` are in them. Raises
    ConfigError naming field and file."""
    sigma, bias = np.asarray([config.sigma], np.float64), np.asarray([config.bias], np.float64)
    if config.sigma_table is not None:
        sigma = _load_table(config.sigma_table, "sensor.sigma_table")
    if config.bias_table is not None:
        bias = _load_table(config.bias_table, "sensor.bias_table")
    return widened(sigma, config), bias


def widened(sigma: NDArray[np.float64], config: SensorConfig) -> NDArray[np.float64]:
    """Coefficients (..., terms) of stated sigmas, with the configuration's ``sigma_scale`` and
    ``sigma_added``."""
    sigma = config.sigma_scale * sigma
    sigma[..., 0] += config.sigma_added
    return sigma


def widened_noise(noise: NoiseModel, config: SensorConfig) -> NoiseModel:
    """A noise model that was stated as an object, with the same."""
    if config.sigma_scale == 1 and config.sigma_added == 0:
        return noise
    return _with_sigma(noise, lambda sigma: widened(sigma, config))


def unwidened_noise(noise: NoiseModel, config: SensorConfig) -> NoiseModel:
    """The noise model without ``sigma_scale`` and ``sigma_added``, which are in it."""

    def stated(sigma: NDArray[np.float64]) -> NDArray[np.float64]:
        sigma = sigma.copy()
        sigma[..., 0] -= config.sigma_added
        return sigma / config.sigma_scale

    return _with_sigma(noise, stated)


def _with_sigma(noise: Any, change: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Any:
    """A noise model with other coefficients of sigma: of depth, else of the sigma of a class of its own."""
    if isinstance(noise, PatchNoise):
        return PatchNoise(change(noise.sigma), noise.bias, noise.patch, noise.camera)
    if isinstance(noise, PolynomialNoise):
        return PolynomialNoise(change(noise.sigma)[0].tolist(), noise.bias[0].tolist())
    of, law = (noise.noise, noise.law) if isinstance(noise, WidenedNoise) else (noise, np.array([0.0, 1.0]))
    law = change(law)
    return of if law.tolist() == [0.0, 1.0] else WidenedNoise(of, law)


def evaluate(coefficients: NDArray[np.floating], depth_m: ArrayLike) -> NDArray[np.float64]:
    """Values of (..., TERMS) polynomials at depths that broadcast with (...)."""
    depth = np.asarray(depth_m, np.float64)
    value = np.zeros(np.broadcast_shapes(coefficients.shape[:-1], depth.shape))
    for term in range(coefficients.shape[-1] - 1, -1, -1):
        value = value * depth + coefficients[..., term]
    return value


def _curves(sigma: NDArray[np.float64], bias: NDArray[np.float64], depth_m: NDArray[np.float64]) -> Curves:
    values, means = (evaluate(rows[:, None, :], depth_m) for rows in (sigma, bias))
    return np.maximum(values, LEAST_SIGMA_M), means


def _unscaled(table: CameraNoise) -> CameraNoise:
    """The noise whose sigma was scaled; its bias was not."""
    while isinstance(table, ScaledNoiseTable):
        table = table.of
    return table


def without_bias(depth_m: NDArray[np.floating], table: CameraNoise) -> NDArray[np.float64]:
    """The depths of the surfaces that give measured depths (H, W) on average; 0 where nothing was
    measured."""
    table, measured = _unscaled(table), np.isfinite(depth_m) & (depth_m > 0)
    z = np.where(measured, depth_m, 0.0).astype(np.float64)
    if isinstance(table, NoiseTable) and not table.coefficients[:, 1].any():
        return z
    given = z
    for _ in range(UNBIASED_STEPS):
        z = np.where(measured, np.maximum(given - table.at_pixels(z)[1], 0.5 * given), 0.0)
    return z


def warn_of_bad_sigma(table: CameraNoise, min_depth: float, max_depth: float) -> None:
    """Warn, naming the patch, if sigma falls to zero or below somewhere in the working range.

    Kernels clamp it at LEAST_SIGMA_M, so that a badly fitted patch is merely trusted a lot. Noise that is not
    made of polynomials is left alone.
    """
    table = _unscaled(table)
    if not isinstance(table, NoiseTable):
        return
    depths = np.linspace(min_depth, max_depth, 100)
    sigma = evaluate(table.coefficients[:, None, 0, :].astype(np.float64), depths[None, :])
    bad = np.flatnonzero((sigma <= 0).any(axis=1))
    if len(bad) == 0:
        return
    row, column = divmod(int(bad[0]), table.columns)
    depth = depths[np.argmin(sigma[bad[0]])]
    which = f"patch (row {row}, column {column})" if len(table.coefficients) > 1 else "the polynomial"
    warnings.warn(
        f"sigma of {which} falls to {sigma[bad[0]].min():.4f} m at a depth of {depth:.2f} m and is clamped "
        f"at {LEAST_SIGMA_M} m" + (f"; so do {len(bad) - 1} other patches" if len(bad) > 1 else ""),
        stacklevel=2,
    )


def _table(sigma: NDArray[np.float64], bias: NDArray[np.float64], patch: int, columns: int) -> NoiseTable:
    coefficients = np.ascontiguousarray(np.stack([sigma, bias], axis=1), dtype=np.float32)
    return NoiseTable(coefficients, patch, columns)


def _padded(coefficients: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    if coefficients.ndim != 2 or coefficients.shape[1] < 1:
        raise ConfigError(f"{name} must be of shape (patches, degree + 1), not {coefficients.shape}")
    if coefficients.shape[1] > TERMS:
        raise ConfigError(f"{name} has degree {coefficients.shape[1] - 1}; the highest is {TERMS - 1}")
    if not (np.abs(coefficients) <= np.finfo(np.float32).max).all():  # which is what kernels take
        raise ConfigError(f"{name} holds a value that is not finite")
    return np.pad(coefficients, ((0, 0), (0, TERMS - coefficients.shape[1])))


def _load_table(path: str, field: str) -> NDArray[np.float64]:
    try:
        table = npz_file.read_npy(Path(path))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{field}: {path} cannot be read as a .npy table: {said(error)}") from error
    if table.dtype.kind not in "fiu":
        raise ConfigError(f"{field}: {path} is not a table of numbers")
    return _padded(table.astype(np.float64), f"{field}: {path}")
