"""Facts about the installed torch and the GPUs that it can use."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CudaDevice:
    """A CUDA device.

    Attributes:
        name: torch's name for the device, such as "cuda:0".
        model: such as "NVIDIA GeForce RTX 4090".
        capability: its compute capability, such as "8.9".
        memory_bytes, free_bytes: total memory, and the part that is free now.
    """

    name: str
    model: str
    capability: str
    memory_bytes: int
    free_bytes: int


@dataclass(frozen=True)
class TorchFacts:
    """The installed torch.

    Attributes:
        version: torch's version.
        cuda: the CUDA version that torch was built with; None for a build without CUDA.
        has_mps: True if torch can use Apple's GPU.
    """

    version: str
    cuda: str | None
    has_mps: bool


def torch_facts() -> TorchFacts:
    """Facts about the installed torch.

    Raises:
        ImportError, OSError: torch is missing or broken.
    """
    import torch

    return TorchFacts(str(torch.__version__), torch.version.cuda, bool(torch.backends.mps.is_available()))


def cuda_devices() -> list[CudaDevice]:
    """The CUDA devices that torch can use.

    Raises:
        ImportError, OSError: torch is missing or broken.
        RuntimeError: a device exists, but cannot be used.
    """
    import torch

    if not torch.cuda.is_available():
        return []
    devices = []
    for number in range(torch.cuda.device_count()):
        facts = torch.cuda.get_device_properties(number)
        free, total = torch.cuda.mem_get_info(number)
        devices.append(CudaDevice(f"cuda:{number}", str(facts.name), f"{facts.major}.{facts.minor}", total, free))
    return devices
