"""Creates a map of the method that a configuration or a saved map's file names."""

from pathlib import Path

from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.methods import chunked, chunked_part
from taichi_mrf.methods.map_file import method_of, open_map_file
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.system.files import is_folder


def create_map(config: Config, camera: Camera) -> OccupancyMap:
    """An empty map of the method ``config.method``, whose noise tables must fit ``camera``."""
    m: OccupancyMap = METHODS[config.method].load_class().from_config(config, camera)
    return m


def load_map(path: str | Path, memory_limit_gb: float | None = None) -> OccupancyMap:
    """Load a saved map of any method; ``memory_limit_gb`` overrides its memory limit. Raises MapFileError, or
    CapacityError if there is not enough memory. A map in chunks (.zarr) is loaded as frozen."""
    if is_folder(Path(path)) and Path(path).suffix == SUFFIX:
        return chunked_part.in_memory(chunked.ChunkedMap.open(path), memory_limit_gb)
    with open_map_file(Path(path)) as file:
        method = METHODS[method_of(file)]
    m: OccupancyMap = method.load_class().load(path, memory_limit_gb)
    return m
