"""Which class makes a map: chosen by the configuration's method, or by what a saved map says."""

from pathlib import Path

from taichi_mrf.config.schema import Config, Method
from taichi_mrf.errors import MapFileError
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.map_file import method_of, open_map_file
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.recursive import RecursiveMap
from taichi_mrf.sensor.camera import PinholeCamera

MapClass = type[MRFMap] | type[RecursiveMap]


def create_map(config: Config, camera: PinholeCamera) -> OccupancyMap:
    """An empty map of the method ``config.method``; ``camera`` is what its noise tables must fit."""
    return _map_class(config.method).from_config(config, camera)


def load_map(path: str | Path, memory_limit_gb: float | None = None) -> OccupancyMap:
    """A saved map, whatever its method; ``memory_limit_gb`` takes the place of its own. Raises MapFileError,
    or CapacityError if there is no room for it."""
    if Path(path).is_dir() and Path(path).suffix == SUFFIX:
        raise MapFileError(f"{path}: a map in chunks, which ChunkedMap.open reads")
    with open_map_file(Path(path)) as file:
        method = method_of(file)
    return _map_class(method).load(path, memory_limit_gb)


def _map_class(method: Method) -> MapClass:
    if method == "mrf":
        return MRFMap
    if method == "log_odds":
        return LogOddsMap
    # Imported late: whoever makes another map need not wait for its kernels.
    from taichi_mrf.methods.visibility.map import VisibilityMap

    return VisibilityMap
