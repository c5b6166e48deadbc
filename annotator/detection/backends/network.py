"""What every backend makes of a weights file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8
from pydantic import BaseModel, ConfigDict, Field

from annotator.detection.config import Backend

# Backends that run a converted copy of the weights.
ExportKind = Literal["openvino", "onnxruntime"]

# (n, height, width, RGB), and (n, 4 + classes, anchors); of several in a list each has its own lengths.
Batch = UInt8[np.ndarray, "_ _ _ 3"]
Answer = Float32[np.ndarray, "_ _ _"]


class NetworkFacts(BaseModel):
    """What the rest of the detector needs to know of a network.

    Attributes:
        labels: class names, in the order of the class numbers.
        stride: sides of pictures must be multiples of this, pixels.
        end2end: whether it answers each object once, so that its boxes need no suppression.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    labels: tuple[str, ...] = Field(min_length=1)
    stride: int = Field(ge=1)
    end2end: bool


@runtime_checkable
class Network(Protocol):
    """A trained network, ready to run. Threads may share it."""

    @property
    def backend(self) -> Backend:
        """What runs it."""

    @property
    def facts(self) -> NetworkFacts:
        """Its classes and stride."""

    @property
    def device(self) -> str:
        """Where it runs, as torch names devices: "cpu", "cuda", "cuda:1", "mps"."""

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        """One raw answer a batch of pictures, as `selection.candidates` reads it.

        Args:
            batches: each of one canvas size, (n, height, width, RGB); all of them at once, so that cores that have
                nothing left of one size begin with the next.

        Raises:
            DetectionError: the backend fails, such as for lack of memory.
        """
