"""The direction of gravity from the Azure Kinect's accelerometer, while the device is at rest.

The track IMU holds samples of 40 bytes: time and acceleration, time and angular velocity, in the sensor's own axes.
They are already corrected by the device's calibration (Azure Kinect Sensor SDK, `src/record/internal`,
`matroska_imu_sample_t`; MIT). A block has one of them or, laced, several.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.recordings.kinect.matroska import Block

# Little-endian; nanoseconds on the device's clock, m/s^2, rad/s.
SAMPLE = np.dtype(
    [("time_ns", "<u8"), ("acceleration_mps2", "<f4", 3), ("turn_time_ns", "<u8"), ("turn_rad_s", "<f4", 3)]
)
STANDARD_GRAVITY_MPS2 = 9.80665
# Limit for a device at rest; the sensor's bias is a few hundredths.
MOST_OFF_MPS2 = 0.3
WITHIN_NS = 500_000_000
MOST_SAMPLES = 100


def blocks_near(blocks: Sequence[Block], time_ns: int) -> list[Block]:
    """Returns those of `blocks` (sorted by time) that may hold the samples nearest to a time, within `WITHIN_NS`."""
    middle = bisect_left(blocks, time_ns, key=lambda block: block.time_ns)
    around = blocks[max(middle - MOST_SAMPLES, 0) : middle + MOST_SAMPLES]
    near = sorted(around, key=lambda block: abs(block.time_ns - time_ns))[:MOST_SAMPLES]
    return [block for block in near if abs(block.time_ns - time_ns) <= WITHIN_NS]


def parse_samples(data: bytes, is_laced: bool) -> np.ndarray:
    """Returns the samples in a block's content, of the type `SAMPLE`; none if its size does not fit.

    Laced samples are at the end, after their number minus one and, in two of the three kinds of lacing, their sizes.
    """
    count = data[0] + 1 if is_laced and data else 1
    content = data[len(data) - count * SAMPLE.itemsize :] if len(data) >= count * SAMPLE.itemsize else b""
    if not is_laced and len(data) != SAMPLE.itemsize:
        content = b""
    return np.frombuffer(content, SAMPLE)


def up_at_rest(samples: np.ndarray, time_ns: int) -> Float64[np.ndarray, "3"] | None:
    """Returns the unit vector against gravity in the sensor's axes; None if the device moves or no sample is near.

    At rest, the sensor measures only the force that supports the device.

    Args:
        samples: of the type `SAMPLE`.
        time_ns: time on the device's clock.
    """
    away = np.abs(samples["time_ns"].astype(np.float64) - time_ns)
    nearest = np.argsort(away, kind="stable")[:MOST_SAMPLES]
    near = samples["acceleration_mps2"][nearest[away[nearest] <= WITHIN_NS]].astype(np.float64)
    if len(near) == 0 or not np.isfinite(near).all():
        return None
    mean = near.mean(axis=0)
    length = float(np.linalg.norm(mean))
    is_still = float(np.linalg.norm(near - mean, axis=1).max()) <= MOST_OFF_MPS2
    if not is_still or abs(length - STANDARD_GRAVITY_MPS2) > MOST_OFF_MPS2:
        return None
    return np.asarray(mean / length)
