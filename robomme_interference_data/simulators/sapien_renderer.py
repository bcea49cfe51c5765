"""The renderer of SAPIEN: the Vulkan device that draws, its driver, and whether it is a GPU.

Run as a program in the interpreter of a simulator, it prints them. That interpreter may lack this
package, so this file does not import it, and keeps to Python 3.10. SAPIEN selects the device;
Vulkan itself names the driver, which SAPIEN does not show.
"""

import ctypes
import os
import platform
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

_SECONDS = 300
"""Limit for the program: loading drivers takes long on overloaded machines."""

# Of Vulkan's headers (vulkan_core.h).
_INSTANCE, _PROPERTIES, _DRIVER = 1, 1000059001, 1000196000  # VkStructureType
_VULKAN_1_2 = 1 << 22 | 2 << 12
_DISCRETE, _CPU = 2, 4  # VkPhysicalDeviceType


@cache
def renderer_in(python: str) -> str | None:
    """Return the renderer that SAPIEN uses in an interpreter; None if it cannot draw there.

    Why it cannot is reported when the simulator starts.
    """
    try:
        output = subprocess.check_output(
            [python, __file__],
            env={**os.environ, "PYTHONSAFEPATH": "1"},  # files beside this one hide no modules
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=_SECONDS,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    # Libraries may print before.
    return output.decode().splitlines()[-1]


def describe_renderer() -> str:
    """Return the renderer, such as `NVIDIA H200, driver NVIDIA 570.86, GPU`.

    One that draws in software is also named by the maker of its processor: what PhysX computes
    depends on how a maker approximates reciprocals (the instruction RCPPS).

    Raises:
        LookupError: No device can draw.
    """
    import sapien.render  # it chooses the drivers that Vulkan loads, so it is first

    summary = sapien.render.get_device_summary()
    drivers = vulkan_devices()
    name = _selected(summary, drivers)
    if name not in drivers:
        return name
    kind, driver = drivers[name]
    return f"{name}, driver {driver}, {f'CPU {_processor()}' if kind == _CPU else 'GPU'}"


def _processor() -> str:
    """Return the maker of the processor, such as `GenuineIntel`, or its architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    found = re.search(r"^vendor_id\s*: (.+)$", text, re.MULTILINE)
    return found[1] if found else platform.machine()


def _selected(summary: str, drivers: dict[str, tuple[int, str]]) -> str:
    """Return the name of the device on which SAPIEN draws, given its summary of the devices.

    It prefers CUDA devices, then those with a display, then discrete ones, then those that trace
    rays: `findBestRenderDevice` in SAPIEN's src/device.cpp. ManiSkill asks for a CUDA device, or
    for any.
    """
    pattern = (
        r"GPU: (.+)\n +Supported: (\d)\n +Present: +(\d)\n +cudaId: +(-?\d+)\n +rayTrace: +(\d)"
    )
    found = []
    for name, supported, present, cuda, traces in re.findall(pattern, summary):
        discrete = name in drivers and drivers[name][0] == _DISCRETE
        if supported == "1":
            found.append((int(cuda) >= 0, present, discrete, traces, name))
    if not found:
        raise LookupError("no Vulkan device can draw")
    return str(max(found, key=lambda device: device[:-1])[-1])


class _Create(ctypes.Structure):
    """`VkInstanceCreateInfo`."""

    _fields_ = [
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("application", ctypes.c_void_p),
        ("layers", ctypes.c_uint32),
        ("layer_names", ctypes.c_void_p),
        ("extensions", ctypes.c_uint32),
        ("extension_names", ctypes.c_void_p),
    ]


class _Application(ctypes.Structure):
    """`VkApplicationInfo`."""

    _fields_ = [
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("name", ctypes.c_char_p),
        ("version", ctypes.c_uint32),
        ("engine", ctypes.c_char_p),
        ("engine_version", ctypes.c_uint32),
        ("api", ctypes.c_uint32),
    ]


class _Driver(ctypes.Structure):
    """`VkPhysicalDeviceDriverProperties`."""

    _fields_ = [
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("id", ctypes.c_int),
        ("name", ctypes.c_char * 256),
        ("info", ctypes.c_char * 256),
        ("conformance", ctypes.c_uint8 * 4),
    ]


class _Properties(ctypes.Structure):
    """`VkPhysicalDeviceProperties2`, with its limits as bytes."""

    _fields_ = [
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("versions", ctypes.c_uint32 * 4),
        ("kind", ctypes.c_int),
        ("name", ctypes.c_char * 256),
        ("limits", ctypes.c_uint8 * 2048),
    ]


def vulkan_devices() -> dict[str, tuple[int, str]]:
    """Return the type (`VkPhysicalDeviceType`) and the driver of each Vulkan device, by its name.

    None are found without a Vulkan library.
    """
    usual = "vulkan-1.dll" if sys.platform == "win32" else "libvulkan.so.1"
    try:
        # SAPIEN sets the variable where it brings its own library.
        vulkan = ctypes.CDLL(os.environ.get("SAPIEN_VULKAN_LIBRARY_PATH", usual))
    except OSError:
        return {}
    application = _Application(type=0, api=_VULKAN_1_2)
    create = _Create(type=_INSTANCE, application=ctypes.addressof(application))
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    if vulkan.vkCreateInstance(ctypes.byref(create), None, ctypes.byref(instance)) != 0:
        return {}
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    handles: Any = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
    devices: dict[str, tuple[int, str]] = {}
    for handle in handles:
        driver = _Driver(type=_DRIVER)
        properties = _Properties(type=_PROPERTIES, next=ctypes.addressof(driver))
        vulkan.vkGetPhysicalDeviceProperties2(ctypes.c_void_p(handle), ctypes.byref(properties))
        texts = [text.decode("utf-8", "replace") for text in (driver.name, driver.info)]
        name = properties.name.decode("utf-8", "replace")
        devices.setdefault(name, (properties.kind, " ".join(filter(None, texts))))
    vulkan.vkDestroyInstance(instance, None)
    return devices


if __name__ == "__main__":
    sys.stdout.write(f"\n{describe_renderer()}\n")  # noqa: TID251 - a program of its own
