"""Checks that memory is available before it is allocated: a map that does not fit is a clear error."""

import contextlib
import os
import sys
import time
from pathlib import Path

from taichi_mrf.errors import CapacityError


def available_bytes() -> int | None:
    """Memory in bytes that this process can still allocate: what the machine has free, or less in a container
    or under ``ulimit -v``. None where the system does not report it."""
    known = [each for each in (_of_machine(), _of_container(), _of_process()) if each is not None]
    return min(known) if known else None


def _of_machine() -> int | None:
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None


def _of_container() -> int | None:
    """Bytes left in the control group of this process (cgroup v2)."""
    try:
        groups = Path("/proc/self/cgroup").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    own = next((line.removeprefix("0::/") for line in groups if line.startswith("0::/")), None)
    return None if own is None else left_in_group(Path("/sys/fs/cgroup") / own)


def left_in_group(folder: Path) -> int | None:
    """Bytes that a control group has left, by the files in its folder; None without a limit. Its page cache
    counts as free."""
    try:
        limit = (folder / "memory.max").read_text(encoding="ascii").strip()
        if limit == "max":
            return None
        used = int((folder / "memory.current").read_text(encoding="ascii"))
        lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
        cache = int(dict(line.split() for line in lines).get("inactive_file", 0))
        return max(0, int(limit) - used + cache)
    except (OSError, ValueError):
        return None


def _of_process() -> int | None:
    """Bytes left of the process's address space, if that is limited."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        return max(0, limit - pages * resource.getpagesize())
    except (ImportError, OSError, ValueError):
        return None


def reset_peak_memory() -> None:
    """Reset the peak that :func:`peak_memory_mb` reads, on Linux; no effect elsewhere."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float | None:
    """The process's peak memory since the last reset, in MB (10^6 bytes); None where it is unknown."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) * 1024 / 1e6, 1)
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1)


def check_memory(wanted_bytes: float, what: str, limit_gb: float = 0.0) -> None:
    """Raise CapacityError if ``wanted_bytes`` exceed the limit. ``what`` begins the error's text.

    ``limit_gb`` of 0 means nine tenths of the available memory.
    """
    if limit_gb <= 0 and _allowance.covers(wanted_bytes):
        return
    free = available_bytes() if limit_gb <= 0 else None
    limit = limit_gb * 1e9 if limit_gb > 0 else (0.9 * free if free is not None else None)
    if limit is not None and wanted_bytes > limit:
        raise CapacityError(
            f"{what} would need {wanted_bytes / 1e9:.3g} GB of memory, but only {limit / 1e9:.3g} GB are "
            "available; choose larger voxels, a smaller volume or a smaller sensor.max_depth"
        )
    if free is not None:
        _allowance.renew(max(0.0, 0.9 * free - wanted_bytes))


class _Allowance:
    """A small part of the memory that was free a moment ago, granted without asking the system again: each
    keyframe makes several checks, and a query takes longer than filling most of the arrays."""

    SHARE, SECONDS = 1 / 16, 1.0

    def __init__(self) -> None:
        self._bytes_left = self._until = 0.0

    def renew(self, free: float) -> None:
        """Start a new allowance from the number of free bytes."""
        self._bytes_left, self._until = self.SHARE * free, time.monotonic() + self.SECONDS

    def covers(self, wanted_bytes: float) -> bool:
        """Take ``wanted_bytes`` from the allowance; False if it is too small or too old."""
        if wanted_bytes > self._bytes_left or time.monotonic() > self._until:
            return False
        self._bytes_left -= wanted_bytes
        return True


_allowance = _Allowance()
