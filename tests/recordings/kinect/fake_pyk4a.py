"""A stand-in for pyk4a 1.5.0, with its names, signatures, units and exceptions; a `Script` controls its behaviour.
As in the real package, `K4AException` has no message, `thread_safe=True` is the default, and missing images of a
capture are None.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FPS = IntEnum("FPS", "FPS_5 FPS_15 FPS_30", start=0)
ImageFormat = IntEnum("ImageFormat", "COLOR_MJPG COLOR_NV12 COLOR_YUY2 COLOR_BGRA32", start=0)
DepthMode = IntEnum("DepthMode", "OFF NFOV_2X2BINNED NFOV_UNBINNED WFOV_2X2BINNED WFOV_UNBINNED", start=0)
ColorResolution = IntEnum("ColorResolution", "OFF RES_720P RES_1080P", start=0)


class K4AException(Exception):  # noqa: N818 - its name
    pass


class K4ATimeoutException(K4AException):
    pass


@dataclass
class Capture:
    """One capture; `color` and `depth` may be None."""

    color: np.ndarray | None
    depth: np.ndarray | None
    color_timestamp_usec: int
    color_system_timestamp_nsec: int


@dataclass
class Script:
    """The behaviour of the connected devices.

    Attributes:
        busy: indices of devices that another program uses.
        captures: the results of `get_capture` in order: a capture, "timeout" or "gone"; then timeouts.
        felt: queued accelerations, (device time in microseconds, m/s^2).
    """

    serials: tuple[str, ...] = ("000123456712",)
    busy: tuple[int, ...] = ()
    starts: bool = True
    calibration: str = ""
    captures: list[Capture | str] = field(default_factory=list)
    felt: list[tuple[int, Sequence[float]]] = field(default_factory=list)
    opened: int = 0
    closed: int = 0


def install(monkeypatch: pytest.MonkeyPatch, script: Script) -> None:
    """Makes `import pyk4a` import the stand-in."""

    class PyK4A:
        TIMEOUT_WAIT_INFINITE = -1

        def __init__(self, config: object = None, device_id: int = 0, thread_safe: bool = True) -> None:
            assert not thread_safe, "it holds the GIL while it waits"
            self._id, self.opened, self.is_running = device_id, False, False

        def open(self) -> None:
            if self._id in script.busy or self._id >= len(script.serials):
                raise K4AException()
            self.opened = True
            script.opened += 1

        def close(self) -> None:
            self._require_open()
            self.opened = False
            script.closed += 1

        def start(self) -> None:
            if not self.opened:
                self.open()
            if not script.starts:
                raise K4AException()
            self.is_running = True

        def stop(self) -> None:
            self.is_running = False
            self.close()

        @property
        def serial(self) -> str:
            self._require_open()
            return script.serials[self._id]

        @property
        def calibration_raw(self) -> str:
            self._require_open()
            return script.calibration

        def get_capture(self, timeout: int = TIMEOUT_WAIT_INFINITE) -> Capture:
            self._require_open()
            assert timeout >= 0, "without a timeout, the wait cannot be stopped"
            next_one = script.captures.pop(0) if script.captures else "timeout"
            if next_one == "gone":
                raise K4AException()
            if isinstance(next_one, str):
                time.sleep(min(timeout, 20) / 1000)
                raise K4ATimeoutException()
            return next_one

        def get_imu_sample(self, timeout: int = TIMEOUT_WAIT_INFINITE) -> dict[str, Any] | None:
            self._require_open()
            assert timeout == 0, "a frame must not wait for the accelerometer"
            if not script.felt:
                raise K4ATimeoutException()
            time_us, felt = script.felt.pop(0)
            return {"acc_sample": tuple(felt), "acc_timestamp": time_us}

        def _require_open(self) -> None:
            if not self.opened:
                raise K4AException("Device is not opened")

    module = ModuleType("pyk4a")
    members = (FPS, ImageFormat, DepthMode, ColorResolution, K4AException, K4ATimeoutException, PyK4A)
    for member in members:
        setattr(module, member.__name__, member)
    setattr(module, "Config", dict)  # noqa: B010 - a module has no such attribute
    setattr(module, "connected_device_count", lambda: len(script.serials))  # noqa: B010 - a module has no such attribute
    monkeypatch.setitem(sys.modules, "pyk4a", module)
