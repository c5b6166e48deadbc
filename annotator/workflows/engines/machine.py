"""What this machine has to offer to workers."""

from __future__ import annotations

import os
from pathlib import Path

NVIDIA_DEVICES = "nvidia[0-9]*"


def cuda_devices(devices: Path = Path("/dev")) -> tuple[str, ...]:
    """The GPUs that detectors can use, as `CUDA_VISIBLE_DEVICES` names them.

    Torch, which knows, takes seconds to load: it is asked only where the system shows a device.
    """
    if not any(devices.glob(NVIDIA_DEVICES)):
        return ()
    from annotator.detection.ultralytics_api import api

    count = int(api().torch.cuda.device_count())
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = [str(number) for number in range(count)] if named is None else [n.strip() for n in named.split(",")]
    return tuple(names[:count])
