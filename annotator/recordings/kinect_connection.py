"""Which connected Azure Kinect is meant, by pyk4a, and what to do where there is none or it cannot be opened."""

from __future__ import annotations

import re
from contextlib import suppress
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from annotator.types.errors import DeviceError

NAME = "Azure Kinect"
# A device's serial number has twelve digits; fewer are its place in the list of devices.
INDEX = re.compile(r"\d{1,2}")
BUNDLE = "its package brings the Azure Kinect SDK, for 64-bit Linux with glibc 2.38 or newer and for Windows"


def load_pyk4a() -> ModuleType:
    """The library.

    Raises:
        DeviceError: it is not installed, or cannot be loaded.
    """
    install = 'pip install "annotator[kinect]" (scripts/setup kinect in a clone)'
    try:
        import pyk4a
    except ImportError as error:
        if find_spec("pyk4a") is None:
            raise DeviceError(f"an {NAME} needs pyk4a, which is not installed: {install}; {BUNDLE}") from error
        raise DeviceError(
            f"pyk4a is installed, but its SDK cannot be loaded ({error}); install it anew: {install}; {BUNDLE}"
        ) from error
    module: ModuleType = pyk4a
    return module


# thread_safe=False in what follows: with it, pyk4a would keep Python's lock while it waits for a picture, and every
# other thread would wait, too. One thread uses the device anyway.


def open_device(k4a: ModuleType, config: Any, which: str | None) -> tuple[Any, str]:
    """A device, opened, and its serial number.

    Args:
        k4a: as `load_pyk4a` gives it.
        config: a `Config` of it.
        which: as of `KinectDevice`.

    Raises:
        DeviceError: no such device, or it cannot be opened.
    """
    count = k4a.connected_device_count()
    if not count:
        raise DeviceError(
            f"no {NAME} is connected; check its power supply and its USB 3 cable. On Linux the user needs the "
            "SDK's udev rules (99-k4a.rules), too"
        )
    if which is not None and not INDEX.fullmatch(which):
        return _open_serial(k4a, config, which, count)
    index = int(which or 0)
    if index >= count:
        raise DeviceError(f"there is no {NAME} number {index}: {count} connected, counted from 0")
    device = k4a.PyK4A(config, index, thread_safe=False)
    try:
        device.open()
        return device, str(device.serial)
    except k4a.K4AException as error:
        _close_quietly(device)
        raise DeviceError(
            f"{NAME} number {index} cannot be opened: another program uses it, or this user may not (on Linux the "
            "SDK's udev rules, 99-k4a.rules, allow it); close the other program, or plug the device in anew"
        ) from error


def _open_serial(k4a: ModuleType, config: Any, serial: str, count: int) -> tuple[Any, str]:
    found = []
    for index in range(count):
        device = k4a.PyK4A(config, index, thread_safe=False)
        with suppress(k4a.K4AException):  # used by somebody else: it is told among those that were found
            device.open()
            if str(device.serial) == serial:
                return device, serial
            found.append(str(device.serial))
        _close_quietly(device)
    hidden = f" and {count - len(found)} that cannot be opened" if len(found) < count else ""
    raise DeviceError(
        f"no {NAME} with the serial number {serial} can be opened; there are {', '.join(found) or 'none'}{hidden}"
    )


def _close_quietly(device: Any) -> None:
    if device.opened:
        device.close()
