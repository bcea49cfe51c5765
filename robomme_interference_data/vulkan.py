"""Find the Vulkan devices that the simulator can render on.

Standard library only, and runnable as a file, so that set-up can ask before anything is
installed: `python3 robomme_interference_data/vulkan.py` prints what it found as JSON and exits
with 0 if a device can render.
"""

import ctypes
import json
import subprocess
import sys
from dataclasses import asdict, dataclass

__all__ = ["VulkanDevice", "VulkanReport", "find_vulkan"]

REQUIRED_FEATURE = "descriptorBindingPartiallyBound"
"""Device feature without which sapien 3.0 finds no supported device. Mesa's software driver has it
in the 25.0 of Debian's bookworm-backports, not in the 22.3 of Debian 12 itself."""

_DEVICE_TYPE_CPU = 4
_API_VERSION_1_2 = (1 << 22) | (2 << 12)
# Values of VkStructureType.
_APPLICATION_INFO = 0
_INSTANCE_CREATE_INFO = 1
_FEATURES_2 = 1000059000
_DESCRIPTOR_INDEXING_FEATURES = 1000161001
_TIMEOUT_S = 20


@dataclass(frozen=True)
class VulkanDevice:
    """A physical device that the Vulkan loader lists.

    Attributes:
        name: Name that the driver gives it.
        software: Whether it renders on the CPU.
        usable: Whether it has the feature that the simulator needs.
    """

    name: str
    software: bool
    usable: bool


@dataclass(frozen=True)
class VulkanReport:
    """What was found.

    Attributes:
        devices: All devices, in the loader's order.
        problem: Why no device can render; None if one can.
    """

    devices: tuple[VulkanDevice, ...]
    problem: str | None


def find_vulkan() -> VulkanReport:
    """List the Vulkan devices of this machine.

    The search runs in a process of its own, because a broken driver can crash its process or
    never return.
    """
    command = [sys.executable, "-I", __file__]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return VulkanReport((), f"a Vulkan driver did not answer within {_TIMEOUT_S} s")
    if done.returncode not in (0, 1) or not done.stdout:
        return VulkanReport((), f"a Vulkan driver crashed (exit status {done.returncode})")
    found = json.loads(done.stdout)
    devices = tuple(VulkanDevice(**device) for device in found["devices"])
    return VulkanReport(devices, found["problem"])


class _ApplicationInfo(ctypes.Structure):
    _fields_ = (
        ("structure_type", ctypes.c_int32),
        ("next", ctypes.c_void_p),
        ("application_name", ctypes.c_char_p),
        ("application_version", ctypes.c_uint32),
        ("engine_name", ctypes.c_char_p),
        ("engine_version", ctypes.c_uint32),
        ("api_version", ctypes.c_uint32),
    )


class _InstanceCreateInfo(ctypes.Structure):
    _fields_ = (
        ("structure_type", ctypes.c_int32),
        ("next", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("application_info", ctypes.POINTER(_ApplicationInfo)),
        ("layer_count", ctypes.c_uint32),
        ("layer_names", ctypes.c_void_p),
        ("extension_count", ctypes.c_uint32),
        ("extension_names", ctypes.c_void_p),
    )


class _DeviceProperties(ctypes.Structure):
    _fields_ = (
        ("versions_and_ids", ctypes.c_uint32 * 4),
        ("device_type", ctypes.c_int32),
        ("name", ctypes.c_char * 256),
        ("rest", ctypes.c_uint8 * 1024),  # 548 bytes in Vulkan 1.0 to 1.4, and room to spare
    )


class _DescriptorIndexingFeatures(ctypes.Structure):
    _fields_ = (
        ("structure_type", ctypes.c_int32),
        ("next", ctypes.c_void_p),
        ("before", ctypes.c_uint32 * 17),
        ("partially_bound", ctypes.c_uint32),
        ("after", ctypes.c_uint32 * 2),
    )


class _Features2(ctypes.Structure):
    _fields_ = (
        ("structure_type", ctypes.c_int32),
        ("next", ctypes.POINTER(_DescriptorIndexingFeatures)),
        ("features", ctypes.c_uint32 * 55),
    )


def _search() -> VulkanReport:
    """Ask the Vulkan loader, in this process."""
    if not sys.platform.startswith("linux"):
        return VulkanReport((), f"not looked for on {sys.platform}")
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return VulkanReport((), "the Vulkan loader (libvulkan.so.1) is not installed")
    # Without argument types, ctypes would cut the 64-bit handles to 32 bits.
    pointer = ctypes.c_void_p
    vulkan.vkCreateInstance.argtypes = (pointer, pointer, pointer)
    vulkan.vkDestroyInstance.argtypes = (pointer, pointer)
    vulkan.vkEnumeratePhysicalDevices.argtypes = (pointer, pointer, pointer)
    vulkan.vkGetPhysicalDeviceProperties.argtypes = (pointer, pointer)
    vulkan.vkGetPhysicalDeviceFeatures2.argtypes = (pointer, pointer)

    application = _ApplicationInfo(_APPLICATION_INFO, api_version=_API_VERSION_1_2)
    info = _InstanceCreateInfo(_INSTANCE_CREATE_INFO, None, 0, ctypes.pointer(application))
    instance = ctypes.c_void_p()
    if vulkan.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)) != 0:
        return VulkanReport((), "no Vulkan driver is installed")
    try:
        devices = tuple(_describe(vulkan, handle) for handle in _handles(vulkan, instance))
    finally:
        vulkan.vkDestroyInstance(instance, None)
    if any(device.usable for device in devices):
        return VulkanReport(devices, None)
    if devices:
        return VulkanReport(devices, f"no device has {REQUIRED_FEATURE}: the driver is too old")
    return VulkanReport((), "the Vulkan drivers list no device")


def _handles(vulkan: ctypes.CDLL, instance: ctypes.c_void_p) -> list[int]:
    count = ctypes.c_uint32()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    handles = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
    return [handle for handle in handles[: count.value] if handle is not None]


def _describe(vulkan: ctypes.CDLL, handle: int) -> VulkanDevice:
    properties = _DeviceProperties()
    vulkan.vkGetPhysicalDeviceProperties(handle, ctypes.byref(properties))
    indexing = _DescriptorIndexingFeatures(_DESCRIPTOR_INDEXING_FEATURES)
    features = _Features2(_FEATURES_2, ctypes.pointer(indexing))
    vulkan.vkGetPhysicalDeviceFeatures2(handle, ctypes.byref(features))
    return VulkanDevice(
        name=properties.name.decode(errors="replace"),
        software=properties.device_type == _DEVICE_TYPE_CPU,
        usable=bool(indexing.partially_bound),
    )


if __name__ == "__main__":
    report = _search()
    sys.stdout.write(json.dumps(asdict(report)) + "\n")
    sys.exit(0 if report.problem is None else 1)
