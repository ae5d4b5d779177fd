"""Cameras and noise models in files: each class gives its arrays, and is made of them again."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from importlib import import_module
from pkgutil import iter_modules, resolve_name
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError

if TYPE_CHECKING:
    from taichi_mrf.system.npz_file import NpzFile

KINDS: dict[str, type["Stored"]] = {}
"""Every class that can be stored by its name, from the moment at which its module is imported."""

StoredT = TypeVar("StoredT", bound="Stored")


class Stored(ABC):
    """The base of cameras and noise models that files can hold."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        KINDS[cls.__name__] = cls

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that :meth:`of_arrays` needs, by name. A subclass without its own is read again as its base."""

    @classmethod
    @abstractmethod
    def of_arrays(cls: type[StoredT], file: "Arrays") -> StoredT:
        """Rebuild the object. Raises the constructor's errors, and the file's error for wrong arrays."""


class Arrays:
    """Some arrays of an open file: those whose names begin with ``prefix``, which is left out here."""

    def __init__(self, file: "NpzFile", prefix: str) -> None:
        self._file, self._prefix = file, prefix

    def __contains__(self, name: str) -> bool:
        return self._prefix + name in self._file

    def array(self, name: str, kinds: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
        """As NpzFile has it."""
        return self._file.array(self._prefix + name, kinds, shape)

    def stored(self, prefix: str) -> Any:
        """As :func:`read_stored` has it, of the arrays whose names begin with ``prefix``."""
        return read_stored(self._file, self._prefix + prefix)


_KIND = "kind"

_TOLD_BY = {
    "distortion": "distortion:DistortedCamera",
    "pinhole": "camera:PinholeCamera",
    "elevations_rad": "spherical:SphericalCamera",
    "patch": "noise:PatchNoise",
    "sigma": "noise:PolynomialNoise",
}
"""Files of earlier versions name no classes: these arrays tell them, and any others are rays."""


def stored_arrays(thing: object, prefix: str = "", what: str = "a noise model") -> dict[str, NDArray[Any]]:
    """A camera or a noise model as arrays by name. Raises MapFileError for one that cannot be saved."""
    if not isinstance(thing, Stored):
        name = type(thing).__name__
        raise MapFileError(f"{what} of type {name} cannot be saved: its class is not derived from Stored")
    arrays = thing.arrays()
    if type(thing).arrays is not _told(arrays).arrays:
        arrays = {**arrays, _KIND: np.asarray(type(thing).__name__)}
    return {prefix + name: values for name, values in arrays.items()}


def is_stored(file: "NpzFile", prefix: str) -> bool:
    """True if a file holds a camera or a noise model under these names."""
    return any(prefix + name in file for name in (_KIND, *_TOLD_BY))


def read_stored(file: "NpzFile", prefix: str = "") -> Any:
    """The object that :func:`stored_arrays` stored. Raises the file's error, also for a class that is neither
    of this package nor imported."""
    found, what = Arrays(file, prefix), prefix.rstrip("_") or "the noise"
    name = found.array(_KIND, "U", ()).item() if _KIND in found else None
    if name is not None and name not in KINDS:
        for module in iter_modules(import_module(__package__).__path__, f"{__package__}."):
            import_module(module.name)
    if name is not None and name not in KINDS:
        lacks = f"is of the class {name}, which is not loaded: import the module that defines it first"
        raise file.problem(what, lacks)
    with file.values_of(what):
        kind = _told(each for each in _TOLD_BY if each in found) if name is None else KINDS[name]
        return kind.of_arrays(found)


def _told(names: Iterable[str]) -> type[Stored]:
    """The class that arrays of these names tell."""
    held = set(names)
    place = next((place for name, place in _TOLD_BY.items() if name in held), "ray_table:RayTable")
    found: type[Stored] = resolve_name(f"taichi_mrf.sensor.{place}")
    return found
