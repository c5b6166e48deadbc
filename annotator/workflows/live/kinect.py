"""A connected Azure Kinect as a source of live frames."""

from __future__ import annotations

import threading
import time

from annotator.recordings.kinect.device import KinectDevice
from annotator.workflows.live.source import Taken


class KinectSource:
    """A `Source` of the frames of a device.

    Attributes:
        skipped: 0, since late frames are dropped by the pipeline.
        gives_newest: False, since the driver queues unread frames.
    """

    skipped = 0
    gives_newest = False

    def __init__(self, which: str | None = None) -> None:
        """
        Args:
            which: as for `KinectDevice`.

        Raises:
            DeviceError: there is no such device, or it cannot be used.
        """
        self._device = KinectDevice(which)

    @property
    def name(self) -> str:
        return self._device.name

    def read(self, stop: threading.Event) -> Taken | None:
        """As `Source.read`."""
        arrived = self._device.next_frame(stop)
        if arrived is None:
            return None
        return Taken(arrived.frame, arrived.arrived_s, time.perf_counter() - arrived.arrived_s)

    def resume(self) -> None:
        """Discards the frames in the driver's queue."""
        self._device.skip_old()

    def close(self) -> None:
        """Releases the device."""
        self._device.close()
