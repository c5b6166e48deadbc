"""A connected Azure Kinect, simulated by a stand-in for pyk4a: its frames and its errors."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fake_pyk4a import Capture, Script, install
from kinect_recording import ACCELEROMETER, DEPTH_HEIGHT, DEPTH_WIDTH, calibration, depth_mm, picture

from annotator.recordings.kinect import device as kinect_device
from annotator.recordings.kinect.device import KinectDevice
from annotator.types.errors import DeviceError
from annotator.workflows.live.open_source import KinectSource

GO_ON = threading.Event()
# The acceleration at rest of an upright device, whose y axis points down.
AT_REST = 9.81 * ACCELEROMETER @ np.array([0.0, -1.0, 0.0])


def capture(number: int, *, color: bool = True, depth: bool = True) -> Capture:
    """A capture of the synthetic recording, binned."""
    bgra = np.dstack([picture(number)[:, :, ::-1], np.full((720, 1280), 255, np.uint8)])
    return Capture(
        np.ascontiguousarray(bgra) if color else None,
        depth_mm(number) if depth else None,
        1_000_000 + 33_333 * number,
        time.perf_counter_ns(),
    )


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Script:
    made = Script(calibration=json.dumps(calibration()))
    install(monkeypatch, made)
    return made


@pytest.fixture
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shortens the timeouts."""
    monkeypatch.setattr(kinect_device, "FIRST_FRAME_WITHIN_S", 0.2)
    monkeypatch.setattr(kinect_device, "NEXT_FRAME_WITHIN_S", 0.1)


def test_frames_of_a_device_have_the_same_content_as_those_of_a_recording(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kinect_device, "DEPTH_SIZE", (320, 288))
    script.captures = ["timeout", capture(0), capture(1, depth=False), capture(2)]
    script.felt = [(990_000 + 100 * n, AT_REST) for n in range(50)]
    device = KinectDevice()
    first, second = device.next_frame(GO_ON), device.next_frame(GO_ON)
    assert first is not None and second is not None
    frame, arrived_s = first
    assert (frame.key, frame.timestamp_ns) == ("000000", 1_000_000_000)
    assert (second[0].key, second[0].timestamp_ns) == ("000001", 1_066_666_000)
    assert (frame.rgb == picture(0)).all()
    assert frame.camera.width_px == 1280
    assert len(frame.cloud) > 10_000
    assert frame.cloud.rgb is not None
    # the wall at 2 m and the post at 1 m, seen by the colour camera
    assert {round(float(z), 1) for z in np.percentile(frame.cloud.xyz_m[:, 2], [1, 50])} == {1.0, 2.0}
    assert frame.up is not None
    assert np.degrees(np.arccos(frame.up @ [0, -1, 0])) < 0.01
    assert time.perf_counter() - 5 < arrived_s <= time.perf_counter()
    device.close()
    device.close()
    assert (script.opened, script.closed) == (1, 1)


def test_a_device_is_selected_by_serial_number_or_index(script: Script) -> None:
    script.serials, script.busy = ("000000000011", "000000000022", "000000000033"), (0,)
    for which, serial in (("1", "000000000022"), ("000000000033", "000000000033")):
        device = KinectDevice(which)
        assert device.name == f"Azure Kinect {serial}"
        device.close()
    assert script.opened == script.closed, "devices that were only inspected are closed again"


@pytest.mark.parametrize(
    ("change", "which", "said"),
    [
        (lambda s: setattr(s, "serials", ()), None, "no Azure Kinect is connected; check its power supply"),
        (lambda s: None, "000000000099", "Kinect 000000000099 can be opened; of 1 connected, .*: 000123456712"),
        (lambda s: setattr(s, "busy", (0,)), None, "another program uses it"),
        (lambda s: setattr(s, "starts", False), None, "its cameras do not start. Its firmware may be too"),
        (lambda s: setattr(s, "calibration", "{}"), None, "calibration cannot be used .CalibrationInformation"),
    ],
)
def test_an_unusable_device_is_an_error_and_is_closed(
    script: Script, change: Callable[[Script], None], which: str | None, said: str
) -> None:
    change(script)
    with pytest.raises(DeviceError, match=said):
        KinectDevice(which)
    assert script.opened == script.closed


def test_without_pyk4a_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyk4a", None)
    with pytest.raises(DeviceError, match=r'cannot be imported .*pip install "rcv-annotator\[kinect\]".*glibc 2\.38'):
        KinectDevice()


@pytest.mark.parametrize("end", ["unplugged", "silent", "only colour"])
def test_an_unplugged_or_silent_device_is_an_error(script: Script, short_timeouts: None, end: str) -> None:
    script.captures = [capture(0)]
    if end == "unplugged":
        script.captures.append("gone")
    if end == "only colour":
        script.captures += [capture(1, depth=False)] * 3
    source = KinectSource()
    script.captures[0].depth = np.full((576, 640), 1000, np.uint16)  # type: ignore[union-attr]
    taken = source.read(GO_ON)
    assert taken is not None
    assert 0 <= taken.read_s < 10
    said = "disconnected; it was unplugged" if end == "unplugged" else "no frame for 0.1 s"
    with pytest.raises(DeviceError, match=said):
        source.read(GO_ON)
    source.close()
    assert (script.opened, script.closed) == (1, 1)


def test_a_missing_first_frame_and_images_of_another_size_are_errors(script: Script, short_timeouts: None) -> None:
    device = KinectDevice()
    with pytest.raises(DeviceError, match=r"no frame for 0\.2 s"):
        device.next_frame(GO_ON)
    script.captures = [capture(0)]  # binned, although the device was opened unbinned
    with pytest.raises(DeviceError, match=rf"its images are \({DEPTH_HEIGHT}, {DEPTH_WIDTH}\)"):
        device.next_frame(GO_ON)


def test_waiting_for_a_frame_can_be_stopped_and_old_frames_are_skipped(script: Script) -> None:
    source = KinectSource()
    stop = threading.Event()
    got: list[Any] = []
    thread = threading.Thread(target=lambda: got.append(source.read(stop)))
    thread.start()
    stop.set()
    thread.join(10)
    assert got == [None]
    script.captures = [capture(0), capture(1)]
    source.resume()
    assert script.captures == []
