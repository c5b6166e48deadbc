"""A connected Azure Kinect as a source of live frames."""

from __future__ import annotations

import threading
import time

from annotator.recordings.kinect_device import KinectDevice
from annotator.workflows.live.source import Taken


class KinectSource:
    """A `Source` of what a device sees now.

    Attributes:
        skipped: none: what the pipeline has no time for is dropped there.
        gives_newest: not so: the driver queues what nobody takes.
    """

    skipped = 0
    gives_newest = False

    def __init__(self, which: str | None = None) -> None:
        """
        Args:
            which: as of `KinectDevice`.

        Raises:
            DeviceError: there is no such device, or it cannot be used.
        """
        self._device = KinectDevice(which)

    @property
    def name(self) -> str:
        return self._device.name

    def read(self, stop: threading.Event) -> Taken | None:
        """As `Source.read`."""
        found = self._device.next_frame(stop)
        return None if found is None else Taken(found.frame, found.arrived_s, time.perf_counter() - found.arrived_s)

    def resume(self) -> None:
        """Leaves out what the device still holds."""
        self._device.skip_old()

    def close(self) -> None:
        """Gives the device back."""
        self._device.close()
