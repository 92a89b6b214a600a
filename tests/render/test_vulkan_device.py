"""Which devices draw, as the Vulkan loader names them."""

import ctypes
import ctypes.util
from collections.abc import Iterator

import pytest

from render import vulkan_device
from render.vulkan_device import VulkanDevice, draws_by_processor, vulkan_devices

CARD, PROCESSOR = VulkanDevice("a card", False), VulkanDevice("llvmpipe", True)


@pytest.fixture
def asked_anew() -> Iterator[None]:
    vulkan_devices.cache_clear()
    yield
    vulkan_devices.cache_clear()


def test_each_device_has_a_name(asked_anew):
    if ctypes.util.find_library("vulkan") is None:
        pytest.skip("no Vulkan loader here")
    devices = vulkan_devices()
    assert all(device.name.isprintable() and device.name for device in devices)
    # Mesa's driver says itself that it is a processor.
    assert all(device.is_processor for device in devices if "llvmpipe" in device.name)


def test_without_a_loader_there_are_no_devices(asked_anew, monkeypatch):
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    assert vulkan_devices() == ()


@pytest.mark.parametrize(
    ("devices", "by_processor"),
    [((), False), ((CARD,), False), ((PROCESSOR,), True), ((PROCESSOR, CARD), False)],
)
def test_the_processor_draws_where_there_is_no_card(monkeypatch, devices, by_processor):
    monkeypatch.setattr(vulkan_device, "vulkan_devices", lambda: devices)
    assert draws_by_processor() == by_processor
