"""Starting Taichi once, on the best backend there is."""

import taichi as ti

_arch: str | None = None


def init(arch: str = "auto", threads: int = 0, debug: bool = False) -> str:
    """Start Taichi; returns the backend's name. Idempotent."""
    global _arch
    if _arch is None:
        options = {"cpu_max_num_threads": threads} if threads else {}
        ti.init(arch=ti.vulkan if arch == "vulkan" else ti.cpu, debug=debug, log_level=ti.ERROR, **options)
        _arch = "vulkan" if arch == "vulkan" else "cpu"
    return _arch


def active() -> str | None:
    """The backend that runs ("cuda", "vulkan", "cpu"), or None before :func:`init`."""
    return _arch
