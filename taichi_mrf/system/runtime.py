"""Starts Taichi once, on the best backend of this machine, and records the reason for the choice.

A process has one backend, and one compiler of kernels (system/compiler.py): everything about Taichi here also
holds for Quadrants. Importing this module neither loads nor starts a compiler.
"""

import contextlib
import importlib.metadata
import io
import logging
import os
import platform
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import taichi_mrf
from taichi_mrf.errors import BackendError
from taichi_mrf.system import compiler, compiling, devices, owner, taichi_environment

BACKENDS = ("cuda", "vulkan", "cpu")
"""In the order in which "auto" tries them."""

ABILITIES = {
    "cuda": "sparse map without bounds",
    "vulkan": "map within a bounded volume (VolumeConfig.dense_bricks)",
    "cpu": "sparse map without bounds",
}
"""The kind of map that each backend supports: Vulkan has no sparse fields."""

FEWER_PASSES: dict[str, dict[str, tuple[str, ...]]] = {
    "cpu": {"advanced_optimization": ("_choose", "_write_down", "_find_reach")},
    "cuda": {"advanced_optimization": ("_choose", "_write_down", "send_messages")},
    "software": {"cfg_optimization": ()},
}
"""The compiler's optimisation that is off, because it takes nine tenths of the time of compiling, and the
kernels of a new keyframe that it is on for (docs/compilers.md). Vulkan cannot do without the advanced one."""

SOFTWARE_BLOCK = 8
"""Threads in a block of a software device: in larger ones Mesa's Vulkan skips iterations of long loops."""


@dataclass(frozen=True)
class Backend:
    """The chosen backend, and the reasons why those tried before it were rejected."""

    name: str
    device: str
    reason: str
    rejected: dict[str, str] = field(default_factory=dict)
    software: bool = False
    compiler: str = field(default_factory=lambda: f"{compiler.name()} {_version(compiler.name())}")
    """The package that compiles kernels, and its version."""


@dataclass(frozen=True)
class BackendStatus:
    """Result of trying a backend on this machine: its device, or the problem."""

    name: str
    device: str | None
    problem: str | None
    software: bool
    ability: str


_chosen: Backend | None = None
_starting = threading.Lock()
_log = logging.getLogger(__name__)


def init(arch: str = "auto", threads: int = 0, debug: bool = False, profile: bool = False) -> str:
    """Start Taichi and return the backend's name; :func:`choice` and the log have the details.

    ``arch`` is "cuda", "vulkan", "cpu", or "auto" for the first of these that is available. A software Vulkan
    device is used only for arch="vulkan". ``threads`` limits the CPU backend (0 = all cores), ``debug``
    checks array bounds, ``profile`` lets Taichi time each kernel (benchmarks/speed/profile.py). Once Taichi
    runs, "auto" or the same arch change nothing. The calling thread becomes the owner of Taichi: maps can be
    used in no other thread (system/owner.py).

    Raises BackendError if the requested backend is not available or another one already runs, and in another
    thread or a forked process. A requested backend is never replaced by another one.
    """
    global _chosen
    if arch not in ("auto", *BACKENDS):
        raise BackendError(f"unknown backend '{arch}'; choose from auto, {', '.join(BACKENDS)}")
    with _starting:
        if _chosen is not None:
            owner.check_owner()
        else:
            _chosen = _already_running() or _started(arch, threads, debug, profile)
            owner.claim()
            title = compiler.title()
            _log.info("%s runs on %s (%s), %s", title, _chosen.name, _chosen.device, _chosen.reason)
            for name, why in _chosen.rejected.items():
                _log.info("%s does not run on %s: %s", title, name, why)
    if arch not in ("auto", _chosen.name):
        raise BackendError(
            f"{compiler.title()} already runs on {_chosen.name}: a process has one backend, "
            f"{arch} needs another process"
        )
    if profile and not _profiles_kernels():
        raise BackendError(
            f"{compiler.title()} already runs without its kernel profiler: profiling needs another process"
        )
    return _chosen.name


def _profiles_kernels() -> bool:
    """True if Taichi was started with its kernel profiler, which it has on all backends but Vulkan."""
    from taichi_mrf.system.compiler import ti

    return active() == "vulkan" or bool(ti.cfg.kernel_profiler)


def choice() -> Backend | None:
    """Backend that :func:`init` chose and why, or None before it."""
    return _chosen


def active() -> str | None:
    """The backend that runs ("cuda", "vulkan", "cpu"), or None before :func:`init`."""
    return _chosen.name if _chosen else None


def is_software() -> bool:
    """True if the backend is a software Vulkan device, which needs small thread blocks."""
    return _chosen is not None and _chosen.software


def on_gpu() -> bool:
    """True if kernels run on a GPU: not on a processor, by a software device or without one."""
    return active() in ("cuda", "vulkan") and not is_software()


def settle() -> None:
    """Wait for the kernels in flight, on Vulkan.

    There Taichi 1.7.4 never frees an array that is deleted while a kernel may still use it, so callers that
    delete arrays right after using them call this first. Other backends need no wait.
    """
    if active() == "vulkan":
        _quiet_taichi().sync()


def backends() -> list[BackendStatus]:
    """Every backend of this machine, without starting one. A software Vulkan device is listed as such."""
    found = []
    for name in BACKENDS:
        try:
            device, software = _device(name, allow_software=True)
        except BackendError as error:
            found.append(BackendStatus(name, None, str(error), False, ABILITIES[name]))
        else:
            found.append(BackendStatus(name, device, None, software, ABILITIES[name]))
    return found


def versions() -> dict[str, str]:
    """Versions of this package and of what its results depend on."""
    packages = (compiler.name(), "numpy", "opencv-python-headless")
    return {
        "taichi_mrf": taichi_mrf.__version__,
        "python": platform.python_version(),
        **{name: _version(name) for name in packages},
    }


def _version(package: str) -> str:
    return importlib.metadata.version(package)


def _started(arch: str, threads: int, debug: bool, profile: bool) -> Backend:
    """Start the requested backend, or for "auto" the first that starts."""
    if problem := taichi_environment.cache_problem():
        raise BackendError(problem)
    if taichi_environment.cache_note:
        _log.warning("%s", taichi_environment.cache_note)
    rejected: dict[str, str] = {}
    for name in BACKENDS if arch == "auto" else (arch,):
        try:
            device, software = _device(name, allow_software=arch == "vulkan")
            _start(name, software, threads, debug, profile)
        except BackendError as error:
            if arch != "auto":
                raise BackendError(f"{name} cannot be used: {error}") from error
            rejected[name] = str(error)
            continue
        reason = f"{arch} was asked for" if arch != "auto" else f"the first of {', '.join(BACKENDS)} here"
        return Backend(name, device, reason, rejected, software)
    raise BackendError("; ".join(f"{name}: {why}" for name, why in rejected.items()))


def _device(name: str, allow_software: bool) -> tuple[str, bool]:
    """(name, whether it is software) of the device a backend would use. Raises BackendError."""
    if name == "cuda":
        return devices.cuda_device(), False
    if name == "vulkan":
        device = devices.best_vulkan_device(allow_software)
        return f"{device.name} ({device.kind})", device.software
    return f"{platform.machine()}, {os.cpu_count()} cores", False


def _start(name: str, software: bool, threads: int, debug: bool, profile: bool) -> None:
    """Start Taichi on one backend, quietly. Raises BackendError if Taichi cannot."""
    ti = _quiet_taichi()
    options: dict[str, Any] = {"cpu_max_num_threads": _usable(threads)} if threads else {}
    options["kernel_profiler"] = profile
    for setting, kernels in FEWER_PASSES.get("software" if software else name, {}).items():
        options[setting], compiling.all_passes[setting] = False, kernels
    if software:
        options["default_gpu_block_dim"] = SOFTWARE_BLOCK
    arch = getattr(ti, name)
    with _quiet_start():
        if not ti.lang.misc.is_arch_supported(arch):
            raise BackendError(f"the driver is there, but {compiler.title()} cannot load it")
        if name == "vulkan":  # Taichi's own choice could be a software device beside a real one
            allow_software = all(device.software for device in devices.vulkan_devices())
            index = devices.best_vulkan_device(allow_software).index
            ti._lib.core.set_vulkan_visible_device(str(index))
        try:
            ti.init(arch=arch, debug=debug, log_level=ti.ERROR, enable_fallback=False, **options)
        except RuntimeError as error:
            why = " ".join(str(error).split())
            raise BackendError(f"{compiler.title()} does not start on it: {why}") from error


def _usable(threads: int) -> int:
    """No more threads than the machine has cores: Taichi would start them all."""
    if threads <= devices.cores():
        return threads
    _log.warning(
        "runtime.threads is %d, but this machine has %d cores; one thread is used for each",
        threads,
        devices.cores(),
    )
    return devices.cores()


def _already_running() -> Backend | None:
    """The backend that the program around this library has started with ti.init, if it has."""
    if not compiler.is_loaded():
        return None
    ti = _quiet_taichi()
    if compiler.program() is None:
        return None
    name = "cpu" if ti.cfg.arch == ti.cpu else str(ti.cfg.arch).removeprefix("Arch.")
    if name not in BACKENDS:
        raise BackendError(f"{compiler.title()} already runs on {name}, which this package does not support")
    device, software = _device(name, allow_software=True)
    return Backend(name, device, f"{compiler.title()} was running on it already", software=software)


def _quiet_taichi() -> Any:
    """Taichi, told to log errors only."""
    from taichi_mrf.system.compiler import ti

    ti.set_logging_level(ti.ERROR)
    return ti


@contextlib.contextmanager
def _quiet_start() -> Iterator[None]:
    """Keep ti.init from printing, from asking its home page for a newer version, and from taking
    another backend than it is told because of an environment variable."""
    settings = {compiler.variable("SKIP_VERSION_CHECK"): "ON", compiler.variable("ARCH"): None}
    saved = {key: os.environ.get(key) for key in settings}
    _set_environment(settings)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        _set_environment(saved)


def _set_environment(values: dict[str, str | None]) -> None:
    for key, value in values.items():
        os.environ.pop(key, None)
        if value is not None:
            os.environ[key] = value
