"""The Azure Kinect's accelerometer, which knows where up is while the device stands still.

The track IMU holds samples of 40 bytes: time and acceleration, time and turn rate, in the sensor's own axes, already
corrected by the device's calibration (Azure Kinect Sensor SDK, `src/record/internal`, `matroska_imu_sample_t`; MIT).
A block has one of them or, laced, several.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.recordings.matroska import Block

# Little-endian; nanoseconds on the device's clock, m/s^2, rad/s.
SAMPLE = np.dtype(
    [("time_ns", "<u8"), ("acceleration_mps2", "<f4", 3), ("turn_time_ns", "<u8"), ("turn_rad_s", "<f4", 3)]
)
STANDARD_GRAVITY_MPS2 = 9.80665
# The sensor's bias is some hundredths; somebody who moves the device soon adds more than this.
MOST_OFF_MPS2 = 0.3
WITHIN_NS = 500_000_000
MOST_SAMPLES = 100


def blocks_near(blocks: Sequence[Block], time_ns: int) -> list[Block]:
    """Of blocks in the order of time, those that may hold the samples nearest to a time, `WITHIN_NS` at most away."""
    middle = bisect_left(blocks, time_ns, key=lambda block: block.time_ns)
    around = blocks[max(middle - MOST_SAMPLES, 0) : middle + MOST_SAMPLES]
    near = sorted(around, key=lambda block: abs(block.time_ns - time_ns))[:MOST_SAMPLES]
    return [block for block in near if abs(block.time_ns - time_ns) <= WITHIN_NS]


def parse_samples(data: bytes, is_laced: bool) -> np.ndarray:
    """The samples in a block's content, of the type `SAMPLE`; none where the block is none of the track's.

    Laced samples stand at the end, behind their number less one and, in two of three ways of lacing, their sizes.
    """
    count = data[0] + 1 if is_laced and data else 1
    content = data[len(data) - count * SAMPLE.itemsize :] if len(data) >= count * SAMPLE.itemsize else b""
    if not is_laced and len(data) != SAMPLE.itemsize:
        content = b""
    return np.frombuffer(content, SAMPLE)


def up_at_rest(samples: np.ndarray, time_ns: int) -> Float64[np.ndarray, "3"] | None:
    """The direction against gravity in the sensor's axes, unit length; None where the device moves or nothing is near.

    A device at rest feels what holds it up, and nothing else.

    Args:
        samples: of the type `SAMPLE`.
        time_ns: the moment, on the device's clock.
    """
    away = np.abs(samples["time_ns"].astype(np.float64) - time_ns)
    nearest = np.argsort(away, kind="stable")[:MOST_SAMPLES]
    felt = samples["acceleration_mps2"][nearest[away[nearest] <= WITHIN_NS]].astype(np.float64)
    if len(felt) == 0 or not np.isfinite(felt).all():
        return None
    mean = felt.mean(axis=0)
    length = float(np.linalg.norm(mean))
    is_still = float(np.linalg.norm(felt - mean, axis=1).max()) <= MOST_OFF_MPS2
    if not is_still or abs(length - STANDARD_GRAVITY_MPS2) > MOST_OFF_MPS2:
        return None
    return np.asarray(mean / length)
