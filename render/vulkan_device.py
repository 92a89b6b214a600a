"""The devices that draw, as the Vulkan loader names them."""

import ctypes
import sys
from functools import cache
from typing import NamedTuple

LOADERS = {"win32": "vulkan-1.dll", "darwin": "libvulkan.1.dylib"}
# Of VkInstanceCreateInfo: its type, and its size in 64-bit words; of VkPhysicalDeviceProperties: its size,
# and where type and name are.
INSTANCE_INFO, INFO_WORDS = 1, 8
PROPERTIES_BYTES, TYPE_AT, NAME_AT, NAME_BYTES = 1024, 16, 20, 256
PROCESSOR = 4


class VulkanDevice(NamedTuple):
    """A device's name, and whether it is a processor that imitates a graphics card."""

    name: str
    is_processor: bool


@cache
def vulkan_devices() -> tuple[VulkanDevice, ...]:
    """The devices; none where the loader is missing or has another interface."""
    try:
        vulkan = ctypes.CDLL(LOADERS.get(sys.platform, "libvulkan.so.1"))
    except OSError:
        return ()
    info = (ctypes.c_uint64 * INFO_WORDS)(INSTANCE_INFO)
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    if vulkan.vkCreateInstance(info, None, ctypes.byref(instance)) != 0:
        return ()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    handles = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
    devices = tuple(_device(vulkan, handle) for handle in handles if handle is not None)
    vulkan.vkDestroyInstance(instance, None)
    return devices


def _device(vulkan: ctypes.CDLL, handle: int) -> VulkanDevice:
    properties = ctypes.create_string_buffer(PROPERTIES_BYTES)
    vulkan.vkGetPhysicalDeviceProperties(ctypes.c_void_p(handle), properties)
    kind = int.from_bytes(properties.raw[TYPE_AT : TYPE_AT + 4], sys.byteorder)
    name = properties.raw[NAME_AT : NAME_AT + NAME_BYTES].split(b"\0")[0].decode("utf-8", "replace")
    return VulkanDevice(name, kind == PROCESSOR)


def draws_by_processor() -> bool:
    """Whether no graphics card draws: all devices are processors."""
    devices = vulkan_devices()
    return bool(devices) and all(device.is_processor for device in devices)
