"""Finds and opens a connected Azure Kinect through pyk4a."""

from __future__ import annotations

import re
from contextlib import suppress
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from annotator.types.errors import DeviceError

NAME = "Azure Kinect"
# Serial numbers have twelve digits; one or two digits are an index in the list of devices.
INDEX = re.compile(r"\d{1,2}")
BUNDLE = "its package contains the Azure Kinect SDK, for 64-bit Linux with glibc 2.38 or newer and for Windows"


def load_pyk4a() -> ModuleType:
    """Imports pyk4a.

    Raises:
        DeviceError: it is not installed, or cannot be loaded.
    """
    install = 'pip install "rcv-annotator[kinect]" (scripts/setup kinect in a clone)'
    try:
        import pyk4a
    except ImportError as error:
        if find_spec("pyk4a") is None:
            raise DeviceError(f"an {NAME} needs pyk4a, which is not installed: {install}; {BUNDLE}") from error
        raise DeviceError(
            f"pyk4a is installed, but its SDK cannot be loaded ({error}); reinstall it: {install}; {BUNDLE}"
        ) from error
    module: ModuleType = pyk4a
    return module


# thread_safe=False below: with True, pyk4a holds the GIL while it waits for an image, which blocks all other threads.
# Only one thread uses the device.


def open_device(k4a: ModuleType, config: Any, which: str | None) -> tuple[Any, str]:
    """Opens a device and returns it with its serial number.

    Args:
        k4a: the module from `load_pyk4a`.
        config: a `Config` of that module.
        which: as in `KinectDevice`.

    Raises:
        DeviceError: no such device, or it cannot be opened.
    """
    count = k4a.connected_device_count()
    if not count:
        raise DeviceError(
            f"no {NAME} is connected; check its power supply and its USB 3 cable. On Linux, also install the SDK's "
            "udev rules (99-k4a.rules)"
        )
    if which is not None and not INDEX.fullmatch(which):
        return _open_serial(k4a, config, which, count)
    index = int(which or 0)
    if index >= count:
        raise DeviceError(f"there is no {NAME} number {index}: {count} connected, numbered from 0")
    device = k4a.PyK4A(config, index, thread_safe=False)
    try:
        device.open()
        return device, str(device.serial)
    except k4a.K4AException as error:
        _close_quietly(device)
        raise DeviceError(
            f"{NAME} number {index} cannot be opened: another program uses it, or this user lacks the permission (on "
            "Linux, install the SDK's udev rules, 99-k4a.rules); close the other program, or reconnect the device"
        ) from error


def _open_serial(k4a: ModuleType, config: Any, serial: str, count: int) -> tuple[Any, str]:
    others = []
    for index in range(count):
        device = k4a.PyK4A(config, index, thread_safe=False)
        with suppress(k4a.K4AException):  # in use by another program; counted in the message below
            device.open()
            if str(device.serial) == serial:
                return device, serial
            others.append(str(device.serial))
        _close_quietly(device)
    if len(others) < count:
        others.append(f"{count - len(others)} that cannot be opened")
    raise DeviceError(f"no {NAME} with the serial number {serial} can be opened; connected: {', '.join(others)}")


def _close_quietly(device: Any) -> None:
    if device.opened:
        device.close()
