"""Starting Taichi: which backend, why not the others, once only, without a word on the terminal.

A process can start Taichi once, so that most of these tests run a program of their own.
"""

import os

import pytest
from new_interpreter import output, python

from taichi_mrf.errors import BackendError
from taichi_mrf.system import compiler, devices, runtime
from taichi_mrf.system.devices import VulkanDevice

LAVAPIPE = VulkanDevice(0, "llvmpipe", "software")
LAPTOP = VulkanDevice(1, "Laptop Graphics", "integrated GPU")
WORKSTATION = VulkanDevice(2, "Workstation Graphics", "discrete GPU")


@pytest.fixture
def machine_without_taichi(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Choosing without starting: what would be started is noted in the list. Nothing runs before."""
    started: list[str] = []
    monkeypatch.setattr(runtime, "_chosen", None)
    monkeypatch.setattr(runtime, "_already_running", lambda: None)
    monkeypatch.setattr(runtime, "_start", lambda name, *_: started.append(name))
    return started


def has(monkeypatch: pytest.MonkeyPatch, cuda: str | None, vulkan: list[VulkanDevice]) -> None:
    """Give the machine these devices."""

    def cuda_device() -> str:
        if cuda is None:
            raise BackendError("no NVIDIA driver on this machine")
        return cuda

    monkeypatch.setattr(devices, "cuda_device", cuda_device)
    monkeypatch.setattr(devices, "vulkan_devices", lambda: vulkan)


@pytest.mark.parametrize(
    ("cuda", "vulkan", "expected"),
    [
        ("GPU", [LAPTOP], "cuda"),
        (None, [LAVAPIPE, LAPTOP], "vulkan"),
        (None, [LAVAPIPE], "cpu"),
        (None, [], "cpu"),
    ],
)
def test_auto_takes_cuda_then_a_real_vulkan_device_then_the_cpu(
    monkeypatch: pytest.MonkeyPatch,
    machine_without_taichi: list[str],
    cuda: str | None,
    vulkan: list[VulkanDevice],
    expected: str,
) -> None:
    has(monkeypatch, cuda, vulkan)
    assert runtime.init() == expected
    assert machine_without_taichi == [expected]
    choice = runtime.choice()
    assert choice is not None
    assert list(choice.rejected) == list(runtime.BACKENDS[: runtime.BACKENDS.index(expected)])
    assert all(choice.rejected.values())
    assert not runtime.is_software()


def test_a_software_vulkan_device_is_taken_when_asked_for(
    monkeypatch: pytest.MonkeyPatch, machine_without_taichi: list[str]
) -> None:
    has(monkeypatch, None, [LAVAPIPE])
    assert runtime.init("vulkan") == "vulkan"
    assert runtime.is_software()


def test_auto_goes_on_when_a_backend_does_not_start(
    monkeypatch: pytest.MonkeyPatch, machine_without_taichi: list[str]
) -> None:
    has(monkeypatch, "GPU", [])

    def start(name: str, software: bool, threads: int, debug: bool, profile: bool) -> None:
        if name == "cuda":
            raise BackendError("Taichi does not start on it: out of memory")

    monkeypatch.setattr(runtime, "_start", start)
    assert runtime.init() == "cpu"
    choice = runtime.choice()
    assert choice is not None
    assert "out of memory" in choice.rejected["cuda"]


def test_what_is_asked_for_and_not_there_is_an_error(
    monkeypatch: pytest.MonkeyPatch, machine_without_taichi: list[str]
) -> None:
    has(monkeypatch, None, [])
    with pytest.raises(BackendError, match="cuda cannot be used: no NVIDIA driver"):
        runtime.init("cuda")
    with pytest.raises(BackendError, match="vulkan cannot be used: the Vulkan driver lists no device"):
        runtime.init("vulkan")
    with pytest.raises(BackendError, match="unknown backend 'metal'"):
        runtime.init("metal")
    assert runtime.active() is None
    assert machine_without_taichi == []


def test_a_discrete_gpu_comes_before_an_integrated_one_before_software(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for present, best in (
        ([LAVAPIPE, LAPTOP, WORKSTATION], WORKSTATION),
        ([LAVAPIPE, LAPTOP], LAPTOP),
        ([LAVAPIPE], LAVAPIPE),
    ):
        monkeypatch.setattr(devices, "vulkan_devices", lambda present=present: present)
        assert devices.best_vulkan_device(allow_software=True) == best


def test_importing_the_package_does_not_load_taichi() -> None:
    program = (
        "import sys, taichi_mrf, taichi_mrf.system.runtime; print(*{'taichi', 'quadrants'} & {*sys.modules})"
    )
    assert output(program) == ""


def test_a_start_is_idempotent_and_another_backend_is_refused() -> None:
    program = """
from taichi_mrf.system import runtime
from taichi_mrf.errors import BackendError
print(runtime.active(), runtime.init("cpu"), runtime.init("cpu"), runtime.init(), runtime.active())
try:
    runtime.init("vulkan")
except BackendError as error:
    print(error)
"""
    lines = output(program).splitlines()
    assert lines[0] == "None cpu cpu cpu cpu"
    assert lines[1].startswith(f"{compiler.title()} already runs on cpu")


def test_the_environment_does_not_change_what_was_asked_for() -> None:
    program = (
        "import os; from taichi_mrf.system import runtime; runtime.init('cpu');"
        "from taichi_mrf.system.compiler import ti;"
        f"print(ti.cfg.arch == ti.cpu, os.environ['{compiler.variable('ARCH')}'])"
    )
    assert output(program, **{compiler.variable("ARCH"): "vulkan"}) == "True vulkan"


def test_a_taichi_that_runs_already_is_used_as_it_is() -> None:
    program = (
        f"import {compiler.name()} as ti"
        + """
ti.init(arch=ti.cpu)
field = ti.field(ti.i32, 3)
from taichi_mrf.system import runtime
field[1] = 7
print(runtime.init(), runtime.choice().reason, field[1])
"""
    )
    assert output(program).splitlines()[-1] == f"cpu {compiler.title()} was running on it already 7"


def test_this_machines_backends_are_told_without_starting_one() -> None:
    program = """
import sys
from taichi_mrf.system import runtime
for status in runtime.backends():
    print(status.name, (status.device is None) == bool(status.problem), bool(status.ability))
print(*{"taichi", "quadrants"} & {*sys.modules})
"""
    assert output(program) == "cuda True True\nvulkan True True\ncpu True True"


def test_the_versions_are_those_that_are_installed() -> None:
    import numpy

    import taichi_mrf

    versions = runtime.versions()
    assert versions["taichi_mrf"] == taichi_mrf.__version__
    assert versions["numpy"] == numpy.__version__
    assert {"python", compiler.name(), "opencv-python-headless"} <= versions.keys()


@pytest.mark.backends
def test_the_backend_of_this_run_is_the_one_asked_for(backend: str, request: pytest.FixtureRequest) -> None:
    assert backend == runtime.active() == request.config.getoption("--arch")


def test_a_process_has_no_more_threads_than_the_machine_has_cores() -> None:
    program = """
import os
import taichi_mrf as tm
tm.init("cpu", threads=100000)
tm.MRFMap(0.1).voxels()
print(len(os.listdir("/proc/self/task")))
"""
    assert int(python("-c", program).stdout) < 4 * os.cpu_count() + 16  # stderr has the warning


def test_more_threads_than_cores_are_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    cores = devices.cores()
    assert runtime._usable(cores) == cores
    assert not caplog.messages
    assert runtime._usable(100_000) == cores
    assert caplog.messages == [
        f"runtime.threads is 100000, but this machine has {cores} cores; one thread is used for each"
    ]


@pytest.mark.usefixtures("backend")
def test_profiling_is_refused_once_taichi_runs_without_its_profiler() -> None:
    if runtime.active() == "vulkan":
        pytest.skip("on Vulkan launches are timed instead of kernels")
    with pytest.raises(BackendError, match="without its kernel profiler"):
        runtime.init(profile=True)
