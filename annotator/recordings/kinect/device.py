"""A connected Azure Kinect through pyk4a (the extra `kinect`), which contains Microsoft's Sensor SDK 1.4.

Both cameras and the accelerometer run. A frame is a colour and a depth image of the same moment, combined as in a
recording (`two_cameras.py`). Interface: pyk4a 1.5.0 (github.com/etiennedub/pyk4a, MIT).
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64

from annotator.geometry.projection import pixel_colors
from annotator.recordings.kinect.calibration import WITHIN_NS, Size, parse_calibration, up_at_rest
from annotator.types import Frame, PointCloud
from annotator.types.errors import DeviceError

LOG = logging.getLogger("annotator.kinect")

# The cameras need a second or two to start.
FIRST_FRAME_WITHIN_S, NEXT_FRAME_WITHIN_S = 10.0, 3.0
# Timeout of one call, milliseconds; `stop` is checked between calls.
WAIT_MS = 200
COLOR_SIZE: Size = (1280, 720)
# The narrow field of view, unbinned (hardware specification: "Depth camera supported operating modes").
DEPTH_MODE, FPS = "NFOV_UNBINNED", "FPS_30"
DEPTH_SIZE: Size = (640, 576)
NS_PER_US = 1000
NAME = "Azure Kinect"
BUNDLE = "its package contains the Azure Kinect SDK, for 64-bit Linux with glibc 2.38 or newer and for Windows"


def load_pyk4a() -> ModuleType:
    try:
        import pyk4a
    except ImportError as error:
        raise DeviceError(
            f'an {NAME} needs pyk4a, which cannot be imported ({error}): pip install "rcv-annotator[kinect]" '
            f"(scripts/setup kinect in a clone); {BUNDLE}"
        ) from error
    module: ModuleType = pyk4a
    return module


# thread_safe=False below: with True, pyk4a holds the GIL while it waits for an image, which blocks all other threads.
# Only one thread uses the device.


def open_device(k4a: ModuleType, config: Any, which: str | None) -> tuple[Any, str]:
    """Opens a device, `which` as in `KinectDevice`, and returns it with its serial number."""
    count = k4a.connected_device_count()
    if not count:
        raise DeviceError(
            f"no {NAME} is connected; check its power supply and its USB 3 cable. On Linux, also install the SDK's "
            "udev rules (99-k4a.rules)"
        )
    opened = []
    for number in range(count):
        device = k4a.PyK4A(config, number, thread_safe=False)
        with suppress(k4a.K4AException):
            device.open()
            opened.append(str(device.serial))
            if which in (None, str(number), opened[-1]):
                return device, opened[-1]
        if device.opened:
            device.close()
    raise DeviceError(
        f"no {NAME} {'' if which is None else f'{which} '}can be opened; of {count} connected, numbered from 0, these "
        f"can be: {', '.join(opened) or 'none'}. Of the others, another program uses it, or this user lacks the "
        "permission (on Linux, install the SDK's udev rules, 99-k4a.rules); close the other program, or reconnect the "
        "device"
    )


class KinectDevice:
    """An open device with running cameras; not thread-safe."""

    def __init__(self, which: str | None = None) -> None:
        """Opens a device and starts its cameras; a DeviceError says why it cannot.

        Args:
            which: its serial number, or its index in the list of devices, from 0; None = the first that can be opened.
        """
        self._k4a = load_pyk4a()
        config = self._k4a.Config(
            color_resolution=self._k4a.ColorResolution.RES_720P,
            color_format=self._k4a.ImageFormat.COLOR_BGRA32,
            depth_mode=self._k4a.DepthMode[DEPTH_MODE],
            camera_fps=self._k4a.FPS[FPS],
            synchronized_images_only=True,
        )
        self._device, serial = open_device(self._k4a, config, which)
        self.name = f"{NAME} {serial}"
        # time, ns, and acceleration, m/s^2
        self._felt: deque[tuple[float, ...]] = deque()
        self._frames = 0
        try:
            with self._errors("its calibration cannot be used ({}); reconnect it, or update its firmware", ValueError):
                content = str(self._device.calibration_raw).encode()
                self.calibration = parse_calibration(content, DEPTH_SIZE, COLOR_SIZE)
            with self._errors(
                "its cameras do not start. Its firmware may be too old for the SDK (update it with "
                "AzureKinectFirmwareTool), its USB port may be slower than USB 3 or shared with other devices, or the "
                "depth engine finds no OpenGL (on Linux it needs a display); see the SDK's messages on standard error"
            ):
                self._device.start()
        except BaseException:
            self.close()
            raise

    @contextmanager
    def _errors(self, problem: str, *kinds: type[Exception]) -> Iterator[None]:
        """Makes errors of the SDK, and of these kinds, a DeviceError; its timeouts pass."""
        try:
            yield
        except self._k4a.K4ATimeoutException:
            raise
        except (self._k4a.K4AException, *kinds) as error:
            raise DeviceError(f"{self.name}: {problem.format(str(error) or 'not readable')}") from error

    def next_frame(self, stop: threading.Event) -> tuple[Frame, float] | None:
        """Waits for the next frame; returns None once `stop` is set.

        Also returns when the colour image arrived at the computer, on the clock of `time.perf_counter`.
        """
        within_s = NEXT_FRAME_WITHIN_S if self._frames else FIRST_FRAME_WITHIN_S
        end_s = time.monotonic() + within_s
        while not stop.is_set():
            capture = self._capture(WAIT_MS)
            if capture is not None and capture.color is not None and capture.depth is not None:
                return self._frame(capture), _arrived_s(capture.color_system_timestamp_nsec)
            if time.monotonic() > end_s:
                raise DeviceError(
                    f"{self.name}: no frame for {within_s:g} s; reconnect it, with its own power supply, to a USB 3 "
                    "port that no other device shares"
                )
        return None

    def resume(self) -> None:
        while self._capture(0) is not None:
            pass

    def close(self) -> None:
        """Stops the cameras and closes the device; further calls do nothing."""
        if not self._device.opened:
            return
        shut_down = self._device.stop if self._device.is_running else self._device.close
        try:
            shut_down()
        except self._k4a.K4AException as error:
            # stopping fails if the device is disconnected
            LOG.warning("%s could not be closed: %s", self.name, error or type(error).__name__)

    def _capture(self, timeout_ms: int) -> Any | None:
        with (
            suppress(self._k4a.K4ATimeoutException),
            self._errors("disconnected; it was unplugged or lost power. Reconnect it and start again"),
        ):
            return self._device.get_capture(timeout=timeout_ms)
        return None

    def _frame(self, capture: Any) -> Frame:
        import cv2

        time_ns = int(capture.color_timestamp_usec) * NS_PER_US
        for image, kind, size, more in (
            (capture.color, np.uint8, COLOR_SIZE, (4,)),
            (capture.depth, np.uint16, DEPTH_SIZE, ()),
        ):
            if image.shape != (*size[::-1], *more) or image.dtype != kind:
                raise DeviceError(
                    f"{self.name}: its images are {image.shape} {image.dtype}, not {size[::-1]} {kind.__name__}"
                )
        rgb: np.ndarray = cv2.cvtColor(capture.color, cv2.COLOR_BGRA2RGB)
        xyz_m, pixel = self.calibration.seen_points(capture.depth)
        cloud = PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel))
        number, self._frames = self._frames, self._frames + 1
        up = self._up(time_ns)
        return Frame(f"{number:06d}", number, self.calibration.color, rgb, cloud, up=up, timestamp_ns=time_ns)

    def _up(self, time_ns: int) -> Float64[np.ndarray, "3"] | None:
        """Returns the unit vector against gravity in the colour camera's frame; None if unknown, or while moving."""
        with (
            suppress(self._k4a.K4ATimeoutException),
            self._errors("its accelerometer is disconnected; reconnect it and start again"),
        ):
            while True:
                sample = self._device.get_imu_sample(timeout=0)
                self._felt.append((int(sample["acc_timestamp"]) * NS_PER_US, *sample["acc_sample"]))
        while self._felt and self._felt[0][0] < time_ns - WITHIN_NS:
            self._felt.popleft()
        up = up_at_rest(np.array(self._felt, float).reshape(-1, 4), time_ns)
        rotation = self.calibration.color_from_accelerometer
        return None if up is None or rotation is None else np.asarray(rotation.apply(up))


def _arrived_s(system_ns: int) -> float:
    """Returns the SDK's arrival time of an image, on the clock of `perf_counter`; now if that is implausible."""
    now, arrived_s = time.perf_counter(), 1e-9 * system_ns
    return arrived_s if 0 <= now - arrived_s < FIRST_FRAME_WITHIN_S else now
