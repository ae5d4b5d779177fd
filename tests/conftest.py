"""Parts that all tests share: the Taichi backend they run on, and where the real recordings lie.

Taichi can be started once in a process, so each backend is a run of its own: ``pytest --arch vulkan``
runs only the tests of kernels that are marked for it (``backends``, ``compilers``, ``smoke``), on Vulkan (a
software device will do).
"""

import importlib.util
import multiprocessing.process
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest
from hypothesis import HealthCheck, settings

from taichi_mrf.errors import BackendError
from taichi_mrf.system import runtime

SETTINGS_OF_A_TEST = "_hypothesis_internal_use_settings"
"""Attribute in which hypothesis keeps what @settings said; it has no public way to ask."""

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent

SERVERS = {
    "playwright": "playwright.sync_api.sync_playwright",  # its own way to start Chromium
    "foxglove": "foxglove.start_server",
    "zenoh": "zenoh.open",
    "viser": "viser.ViserServer.__init__",
}
"""Libraries and their functions that start a process or a server."""

SLOW = (HERE / "datasets" / "doctor", HERE)
"""Folders whose tests take minutes although they are few."""

FOR_EVERY_BACKEND = ("backends", "compilers", "smoke")
"""Markers of the tests that run on every backend."""

FILES = pytest.StashKey[list[pytest.Module]]()
"""With --queue, the files of tests, before they are imported."""

# Kernels compile inside the first example and machines are shared: nothing here is held to a time.
UNTIMED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("default", parent=UNTIMED)
settings.register_profile("ci", parent=UNTIMED, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "default")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--arch", choices=runtime.BACKENDS, default="cpu", help="the Taichi backend to test (default: cpu)"
    )

    parser.addoption(
        "--queue",
        type=Path,
        metavar="DIR",
        help="run only test files that no other run with this folder has taken (see tests/backends.py)",
    )

    parser.addoption(
        "--quick",
        action="store_true",
        help="leave out tests that start Taichi, a process or a server, or read recordings, but for smoke "
        "tests; take a sixth of the other tests' examples",
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--quick"):
        # Its first import on a machine lists the fonts by a process: within a test, --quick would skip that.
        import matplotlib.figure  # noqa: F401
    tests_have_names = any("::" in argument for argument in config.args)
    if config.getoption("--queue") and not config.option.collectonly and not tests_have_names:
        config.stash[FILES] = []


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m` and names of markers alone, files that have none of them are not even imported."""
    every = "" if config.getoption("--arch") == "cpu" else " or ".join(FOR_EVERY_BACKEND)
    chosen: str = config.option.markexpr or every
    if collection_path.suffix != ".py" or not re.fullmatch(r"\w+( or \w+)*", chosen):
        return None
    text = collection_path.read_text(encoding="utf-8")
    return None if any(f"mark.{name}" in text for name in chosen.split(" or ")) else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if "soak" not in config.option.markexpr:
        soak = [item for item in items if item.get_closest_marker("soak")]
        config.hook.pytest_deselected(items=soak)
        items[:] = [item for item in items if item not in set(soak)]
    if config.getoption("--quick"):
        left_out = [
            item for item in items if (_uses(item, "backend") and not _is_smoke(item)) or _is_large(item)
        ]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]
    if config.getoption("--quick") or config.getoption("--arch") == "vulkan":
        for item in items:
            _take_fewer_examples(item)
    if config.getoption("--arch") == "cpu":
        return
    used = [item for item in items if _is_for_every_backend(item)]
    config.hook.pytest_deselected(items=[item for item in items if item not in used])
    items[:] = used


def pytest_make_collect_report(collector: pytest.Collector) -> pytest.CollectReport | None:
    """With --queue, a file is imported by the process that takes it."""
    if not isinstance(collector, pytest.Module) or FILES not in collector.config.stash:
        return None
    collector.config.stash[FILES].append(collector)
    return pytest.CollectReport(collector.nodeid, "passed", None, [])


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """With --queue, take one file of tests after the other until none is left."""
    files = session.config.stash.get(FILES, None)
    if files is None or session.testsfailed:
        return None  # pytest's own loop
    del session.config.stash[FILES]
    tests = _taken_tests(session, files)
    test = next(tests, None)
    while test is not None:
        following = next(tests, None)
        session.config.hook.pytest_runtest_protocol(item=test, nextitem=following)
        if session.shouldfail:
            raise session.Failed(session.shouldfail)
        if session.shouldstop:
            raise session.Interrupted(session.shouldstop)
        test = following
    session.testscollected = len(files)  # 0, as before they were imported, is an error to pytest
    return True


def _taken_tests(session: pytest.Session, files: list[pytest.Module]) -> Iterator[pytest.Item]:
    """The tests of the files that this process is the first to take. It takes those of a folder together,
    because they use the same kernels, which each process compiles; at the end it helps with the folders of
    others. Large ones come first, after those that are slow for their size, so that all processes end at
    about the same time."""
    files = sorted(files, key=lambda file: file.path.stat().st_size, reverse=True)
    folders: dict[Path, list[pytest.Module]] = {}
    for file in files:
        folders.setdefault(file.path.parent, []).append(file)
    sizes = {folder: sum(file.path.stat().st_size for file in inside) for folder, inside in folders.items()}
    for folder in sorted(folders, key=lambda folder: (folder not in SLOW, -sizes[folder])):
        if _is_first(session.config, folder):
            for file in folders[folder]:
                yield from _its_tests(session, file)
    for file in files:
        yield from _its_tests(session, file)


def _its_tests(session: pytest.Session, file: pytest.Module) -> list[pytest.Item]:
    """The tests of a file, none if another process has taken it."""
    if not _is_first(session.config, file.path):
        return []
    items = list(session.genitems(file))
    session.config.hook.pytest_collection_modifyitems(session=session, config=session.config, items=items)
    return items


def _is_first(config: pytest.Config, path: Path) -> bool:
    """True if this process is the first to take a file or folder of tests."""
    try:
        (config.getoption("--queue") / "-".join(path.relative_to(REPOSITORY).parts)).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def _is_for_every_backend(item: pytest.Item) -> bool:
    marked = any(item.get_closest_marker(name) for name in FOR_EVERY_BACKEND)
    return marked and _uses(item, "backend") and not _uses(item, "one_backend")


def _uses(item: pytest.Item, fixture: str) -> bool:
    return fixture in getattr(item, "fixturenames", ())


def _is_large(item: pytest.Item) -> bool:
    """True if it reads a whole recording."""
    return item.get_closest_marker("shared_data") is not None


def _is_smoke(item: pytest.Item) -> bool:
    return item.get_closest_marker("smoke") is not None


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """With --quick, skip a test at the point where it, or a fixture, starts Taichi, a process or a server."""
    with pytest.MonkeyPatch.context() as patch:
        if item.config.getoption("--quick"):
            patch.setattr(subprocess.Popen, "__init__", _leave_out)
            patch.setattr(multiprocessing.process.BaseProcess, "start", _leave_out)
            for library, function in SERVERS.items():
                if importlib.util.find_spec(library) is not None:
                    patch.setattr(function, _leave_out)
            if not _is_smoke(item):
                patch.setattr(runtime, "init", _leave_out)
        yield


def _leave_out(*args: Any, **kwargs: Any) -> NoReturn:
    pytest.skip("left out by --quick: it starts Taichi, a process or a server")


def _take_fewer_examples(item: pytest.Item) -> None:
    """A sixth of the examples: of kernels on a software device, which takes seconds for what a CPU does at
    once, they show whether it does the same, and with --quick whether an edit has broken much."""
    test = getattr(item, "obj", None)
    chosen: settings | None = getattr(test, SETTINGS_OF_A_TEST, None)
    if chosen is not None:
        fewer = settings(chosen, max_examples=max(3, chosen.max_examples // 6))
        setattr(getattr(test, "__func__", test), SETTINGS_OF_A_TEST, fewer)


@pytest.fixture
def own_interrupts() -> Iterator[None]:
    """Python's own handler of SIGINT, which a run in the background inherits as ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def backend(request: pytest.FixtureRequest) -> str:
    """Taichi, started on the backend of this run; the value is the backend's name."""
    arch = request.config.getoption("--arch")
    try:
        return runtime.init(arch)
    except BackendError as error:
        pytest.fail(f"--arch {arch}: {error}", pytrace=False)


@pytest.fixture(scope="session")
def one_backend(backend: str) -> str:
    """The same, for tests of what is no backend's business: one run of them is enough, on the CPU."""
    return backend


@pytest.fixture(scope="session", autouse=True)
def small_pictures() -> Iterator[Any]:
    """Figures are drawn as always, but written with few pixels, which takes a third of the time. The value is
    what writes them with all of theirs."""
    from matplotlib.figure import Figure  # late: half of a run's start

    save = Figure.savefig

    def save_small(figure: Figure, *arguments: Any, **options: Any) -> None:
        save(figure, *arguments, **{**options, "dpi": 20})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", save_small)
        yield save


@pytest.fixture
def full_pictures(small_pictures: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that look at the pixels of figures."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", small_pictures)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium that runs while the tests of a file do."""
    from browser import chromium

    with chromium() as running:
        yield running


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings that lies beside the source tree on some machines."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real recordings are not on this machine ({folder} does not exist)")
    return folder
