"""Settings for training and running a detector, and the expected errors of its edges."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from pydantic import BaseModel, ConfigDict, Field

from annotator.types.bases import Strict

# What runs a trained network. docs/detector_backends.md explains how `auto` and `fastest` choose.
Backend = Literal["auto", "fastest", "torch", "openvino", "openvino-bf16"]

# A guess of the training speed with small views on two cores, for the length of a run before its first epoch.
PICTURES_A_SECOND = 60
# Longest training, minutes: one day.
MOST_MINUTES = 1440


class EdgeErrors(BaseModel):
    """Expected absolute error of an edge: `factor * spread ** exponent`, both in pixels at the network's input size.

    Attributes:
        least_px, most_px: spreads outside this range count as its ends, pixels.
        edges: number of edges that the map was fitted to.
        gain: mean log-likelihood of the errors under this map (Laplace), minus that under one constant error.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    factor: float = Field(gt=0)
    exponent: float = Field(gt=0)
    least_px: float = Field(gt=0)
    most_px: float = Field(gt=0)
    edges: int = Field(0, ge=0)
    gain: float = 0.0

    def of(self, spread_px: Float[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """The expected absolute error of edges with these spreads, pixels."""
        within = np.clip(spread_px.astype(np.float64), self.least_px, self.most_px)
        return np.asarray(self.factor * within**self.exponent)


class TrainingConfig(Strict):
    """Settings of a training run; docs/detector_training.md explains the defaults."""

    model: str = Field("yolo11n", description="an ultralytics detection model: yolo11n, yolov8s, yolov5nu, yolo26n ...")
    pretrained: Literal["auto", "never"] | Path = Field(
        "auto",
        description="auto: published weights if found or downloadable, else random ones; never: random weights; "
        "or the path of a weights file",
    )
    image_size_px: int = Field(
        224, ge=32, le=2048, multiple_of=32, description="longer side of a training image, pixels"
    )
    epochs: int | None = Field(
        None, ge=1, description="passes over the training images; None: as many as `pictures_seen` needs"
    )
    pictures_seen: int = Field(4000, ge=1, description="length of a run without `epochs` and `seconds`, in images")
    seconds: float | None = Field(None, gt=0, description="length of a run without `epochs`, seconds of training")
    batch: int = Field(16, ge=2, description="images per step")
    measure_every: int | None = Field(
        None, ge=1, description="epochs between validations; None: about 12 validations per run"
    )
    recipe: dict[str, float | str] = Field(
        default_factory=dict, description="ultralytics' settings in place of those of `training.trainer_settings`"
    )
    seed: int = Field(0, ge=0)
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1, mps")

    def epochs_for(self, images: int) -> int:
        """Epochs for a number of training images: `epochs` if set, else as `pictures_seen` needs, from 10 to 300.

        For a run of `seconds`, a first guess, which the trainer corrects after each epoch.
        """
        if self.epochs is None and self.seconds is not None:
            return max(round(self.seconds * PICTURES_A_SECOND / images), 2)
        return self.epochs or min(max(round(self.pictures_seen / images), 10), 300)


class DetectorConfig(Strict):
    """Settings for running a trained detector. Device, backend, threads and names are not part of its fingerprint."""

    image_size_px: int = Field(
        ge=32, le=4096, description="input size of the network, longer side, pixels; the training size works best"
    )
    confidence: float = Field(
        0.05,
        ge=0,
        le=1,
        description="boxes with a lower score are dropped; keep it low, since the 3D method weights boxes by score",
    )
    iou: float = Field(
        0.6, ge=0, le=1, description="if two boxes of a class have a higher IoU, only the better one is kept"
    )
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1, mps")
    backend: Backend = Field(
        "auto",
        description="what runs the network; auto: the fastest with the same boxes as torch; fastest: also in bfloat16",
    )
    threads: int | None = Field(None, ge=1, description="processor threads; None: all cores available to the process")
    edge_errors: dict[str, EdgeErrors] = Field(
        {}, description="expected errors of edges by class; boxes of other classes have no `edge_sigma_px`"
    )
    names: dict[str, str | None] = Field(
        {}, description="names of classes that were renamed after the training; None: boxes of the class are left out"
    )
