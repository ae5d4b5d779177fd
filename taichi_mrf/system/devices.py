"""The accelerators of this machine, as the drivers list them.

Taichi only tests whether it can load a driver. The drivers also report whether a Vulkan device is hardware or
software, and why CUDA is not available. Their C interfaces start quickly, and nothing here needs Taichi.
"""

import ctypes
import ctypes.util
import os
import sys
from dataclasses import dataclass

from taichi_mrf.errors import BackendError

_VULKAN_KINDS = {0: "other", 1: "integrated GPU", 2: "discrete GPU", 3: "virtual GPU", 4: "software"}
"""VkPhysicalDeviceType."""

_PREFERENCE = ("discrete GPU", "integrated GPU", "virtual GPU", "other", "software")


@dataclass(frozen=True)
class VulkanDevice:
    """A Vulkan device; ``index`` is its place in the driver's list, by which Taichi selects it."""

    index: int
    name: str
    kind: str

    @property
    def software(self) -> bool:
        """True for a program that imitates a GPU on the CPU, such as Mesa's lavapipe."""
        return self.kind == "software"


class _InstanceInfo(ctypes.Structure):
    """VkInstanceCreateInfo; all zero but the first field asks for a plain Vulkan 1.0 instance."""

    _fields_ = (
        ("sType", ctypes.c_uint32),
        ("pNext", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("pApplicationInfo", ctypes.c_void_p),
        ("enabledLayerCount", ctypes.c_uint32),
        ("ppEnabledLayerNames", ctypes.c_void_p),
        ("enabledExtensionCount", ctypes.c_uint32),
        ("ppEnabledExtensionNames", ctypes.c_void_p),
    )


class _DeviceProperties(ctypes.Structure):
    """The head of VkPhysicalDeviceProperties, and room for the limits that follow it (under 1 kB)."""

    _fields_ = (
        ("apiVersion", ctypes.c_uint32),
        ("driverVersion", ctypes.c_uint32),
        ("vendorID", ctypes.c_uint32),
        ("deviceID", ctypes.c_uint32),
        ("deviceType", ctypes.c_uint32),
        ("deviceName", ctypes.c_char * 256),
        ("rest", ctypes.c_uint64 * 256),
    )


def vulkan_devices() -> list[VulkanDevice]:
    """All Vulkan devices, software ones included, in the driver's order.

    Raises BackendError if there is no Vulkan loader or no driver for it.
    """
    vulkan = _library("Vulkan", {"win32": "vulkan-1.dll", "darwin": "libvulkan.1.dylib"}, "libvulkan.so.1")
    instance = ctypes.c_void_p()
    info = _InstanceInfo(sType=1)  # VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO
    if code := vulkan.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)):
        raise BackendError(f"no Vulkan driver is installed (vkCreateInstance answers {code})")
    try:
        count = ctypes.c_uint32()
        code = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
        handles = (ctypes.c_void_p * count.value)()
        if code == 0:
            code = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
        if code < 0:
            raise BackendError(f"the Vulkan driver lists no devices (it answers {code})")
        devices = []
        for index, handle in enumerate(handles[: count.value]):
            properties = _DeviceProperties()
            vulkan.vkGetPhysicalDeviceProperties(ctypes.c_void_p(handle), ctypes.byref(properties))
            kind = _VULKAN_KINDS.get(properties.deviceType, "other")
            devices.append(VulkanDevice(index, properties.deviceName.decode(errors="replace"), kind))
        return devices
    finally:
        vulkan.vkDestroyInstance(instance, None)


def best_vulkan_device(allow_software: bool) -> VulkanDevice:
    """The Vulkan device of the fastest kind. Raises BackendError if there is none that may be used."""
    devices = sorted(vulkan_devices(), key=lambda device: _PREFERENCE.index(device.kind))
    if not devices:
        raise BackendError("the Vulkan driver lists no device")
    if devices[0].software and not allow_software:
        raise BackendError(
            f"the only Vulkan device is software ({devices[0].name}), which is used only on request"
        )
    return devices[0]


def cuda_device() -> str:
    """The name of the first CUDA device. Raises BackendError if there is none, saying why."""
    cuda, _ = _cuda_devices()
    device, name = ctypes.c_int(), ctypes.create_string_buffer(256)
    cuda.cuDeviceGet(ctypes.byref(device), 0)
    cuda.cuDeviceGetName(name, len(name), device)
    return name.value.decode(errors="replace")


def cuda_device_count() -> int:
    """Number of CUDA devices that this process may use; 0 also without a driver."""
    try:
        return _cuda_devices()[1]
    except BackendError:
        return 0


def _cuda_devices() -> tuple[ctypes.CDLL, int]:
    """The started driver, and the number of its devices. Raises BackendError if there is none."""
    cuda = _library("NVIDIA driver", {"win32": "nvcuda.dll"}, "libcuda.so.1")
    if code := cuda.cuInit(0):
        raise BackendError(f"the NVIDIA driver does not start (cuInit answers {code})")
    count = ctypes.c_int()
    cuda.cuDeviceGetCount(ctypes.byref(count))
    if count.value == 0:
        raise BackendError("the NVIDIA driver lists no device")
    return cuda, count.value


def _library(title: str, names: dict[str, str], otherwise: str) -> ctypes.CDLL:
    """Load a system library by its name on this platform."""
    name = names.get(sys.platform, otherwise)
    try:
        return ctypes.CDLL(name)
    except OSError:
        raise BackendError(f"no {title} on this machine ({name} is not installed)") from None


def cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
