"""The environment that Taichi and matplotlib need before they are loaded: no banner, writable folders.

All of it holds for Quadrants too (system/compiler.py), whose variables and folder have other names.
Taichi 1.7.4 aborts on import if neither HOME nor XDG_CACHE_HOME is set, and ends in a segmentation fault if
its cache cannot be written, even when the cache is switched off (TI_OFFLINE_CACHE=0). matplotlib prints two
lines on stderr if its folder cannot be written.
"""

import contextlib
import os
import stat
import warnings

from taichi_mrf.errors import BackendError
from taichi_mrf.system import compiler
from taichi_mrf.system.compiler import COMPILERS

_BASE = "XDG_CACHE_HOME"
_MATPLOTLIB = "MPLCONFIGDIR"

cache_note: str | None = None
"""Reason why Taichi's compiled kernels are not in the usual folder, and their actual folder."""


def prepare() -> None:
    """Set what has to be set before Taichi is imported, whoever imports it. Without a compiler, or with an
    unknown one, this is not the place to say so."""
    for name, each in COMPILERS.items():
        os.environ.setdefault(each.banner, "0")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module=rf"{name}(\.|$)")
    # Of a NumPy number among a kernel's arguments: Quadrants looks at all of them again in the next call.
    warnings.filterwarnings("ignore", message=r".*Template mapper caching disabled")
    if os.name != "nt":  # on Windows Taichi needs no variable
        with contextlib.suppress(BackendError):
            _choose_cache()
        _choose_matplotlib_folder()


def cache_variable() -> str:
    """The environment variable that names the folder of compiled kernels."""
    return compiler.variable("OFFLINE_CACHE_FILE_PATH")


def cache_folder() -> str | None:
    """The folder of compiled kernels that the environment names, None if it names none."""
    if chosen := os.environ.get(cache_variable()):
        return chosen
    base = os.environ.get(_BASE) or (os.path.join(home, ".cache") if (home := os.environ.get("HOME")) else "")
    return os.path.join(base, *COMPILERS[compiler.name()].cache) if base else None


def first_run_note() -> str | None:
    """Note that the first compilation of kernels takes a while; None if there are compiled kernels in their
    folder, or if none are kept. Look before Taichi is started."""
    folder = cache_folder()
    if folder is None or os.environ.get(compiler.variable("OFFLINE_CACHE")) == "0":
        return None
    if os.path.isdir(folder) and os.listdir(folder):
        return None
    return f"first run: kernels are compiled once, which takes a while, and kept in {folder}"


def cache_problem() -> str | None:
    """Reason why Taichi must not be started: its cache has no writable folder. None if it has one."""
    folder = cache_folder()
    if os.name == "nt" or (folder is not None and _is_writable(folder)):
        return None
    return f"no writable folder for {compiler.title()}'s compiled kernels: set {cache_variable()}"


def _choose_cache() -> None:
    """Choose a private folder among the temporary files if the usual one cannot be used."""
    global cache_note
    usual = cache_folder()
    if usual is None or not _is_writable(usual):
        chosen = _private_folder()
        why = "HOME is not set" if usual is None else f"{usual} cannot be written to"
        if chosen is not None:
            cache_note = f"{why}: {compiler.title()} keeps its compiled kernels in {chosen}"
            os.environ[cache_variable()] = chosen
    if not os.environ.get(_BASE) and (_BASE in os.environ or not os.environ.get("HOME")):
        # Taichi takes an empty name for the root of the file system, and aborts without any.
        home = os.environ.get("HOME")
        os.environ[_BASE] = (
            os.path.join(home, ".cache") if home else os.environ.get(cache_variable()) or os.devnull
        )


def _choose_matplotlib_folder() -> None:
    """Give matplotlib a private folder where it cannot write to its usual ones."""
    if os.environ.get(_MATPLOTLIB):
        return
    home = os.path.expanduser("~")
    configuration = os.environ.get("XDG_CONFIG_HOME") or os.path.join(home, ".config")
    cache = os.environ.get(_BASE) or os.path.join(home, ".cache")
    if not all(_is_writable(os.path.join(base, "matplotlib")) for base in (configuration, cache)):
        folder = _private_folder()
        if folder is not None:
            os.environ[_MATPLOTLIB] = os.path.join(folder, "matplotlib")


def _is_writable(folder: str) -> bool:
    """True if a folder can be written to, or made."""
    path = os.path.abspath(folder)
    while not os.path.lexists(path):
        path = os.path.dirname(path)
    return os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK)


def _private_folder() -> str | None:
    """A folder that no other user can write to: the kernels in it are run. None if none can be made."""
    import tempfile  # rarely needed, and slow to import

    try:
        folder = os.path.join(tempfile.gettempdir(), f"taichi-mrf-{os.getuid()}")
        with contextlib.suppress(FileExistsError):
            os.mkdir(folder, 0o700)
        found = os.lstat(folder)
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return folder
        return tempfile.mkdtemp(prefix="taichi-mrf-")
    except OSError:
        return None
