"""The direction against gravity from a `sensor_msgs/Imu` topic, while the sensor is at rest."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from annotator.recordings.kinect.calibration import MOST_SAMPLES, SAMPLE, WITHIN_NS, up_at_rest
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.messages import FIELD_ERRORS, frame_id, message


def up_near(topic: Topic, log_ns: int) -> tuple[Float64[np.ndarray, "3"], str] | None:
    """Returns the unit vector against gravity at a log time, and the tf frame in which it is given.

    None if the sensor moves, or no message with an acceleration is near.

    Raises:
        OSError: the file cannot be read.
    """
    near = topic.between(log_ns - WITHIN_NS, log_ns + WITHIN_NS)
    numbers = sorted(near, key=lambda i: abs(int(topic.log_ns[i]) - log_ns))[:MOST_SAMPLES]
    samples, frame = np.zeros(len(numbers), SAMPLE), ""
    count = 0
    for i in numbers:
        try:
            content = message(topic, i)
            acceleration = content.linear_acceleration
            samples[count]["acceleration_mps2"] = (acceleration.x, acceleration.y, acceleration.z)
            frame = frame_id(content)
        except FIELD_ERRORS:  # damaged: the others suffice
            continue
        samples[count]["time_ns"] = max(int(topic.log_ns[i]), 0)
        count += 1
    up = up_at_rest(samples[:count], log_ns)
    return None if up is None else (up, frame)
