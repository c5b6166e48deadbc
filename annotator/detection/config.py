"""How a detector is trained, and how it is run."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Role = Literal["image", "view"]
# What runs a trained network; docs/detector_backends.md says how `auto` and `fastest` choose.
Backend = Literal["auto", "fastest", "torch", "openvino", "openvino-bf16", "onnxruntime"]


class Augmentation(BaseModel):
    """Random changes of training pictures. Only such as keep an axis-aligned box the box of the changed picture.

    Rotation by any other angle, shear and perspective are missing on purpose: the box around a turned box is larger
    than the turned object's box, and the detector would learn boxes that are too large.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    flip_horizontal: float = Field(0.0, ge=0, le=1, description="probability of a left-right mirror image")
    flip_vertical: float = Field(0.0, ge=0, le=1, description="probability of an upside-down mirror image")
    quarter_turns: bool = Field(False, description="turn by a random multiple of 90 degrees")
    shift: float = Field(0.1, ge=0, le=0.5, description="largest shift, share of the picture's size")
    scale: float = Field(0.2, ge=0, lt=1, description="largest change of size, share")
    hue: float = Field(0.015, ge=0, le=0.5, description="largest change of hue, share of the colour circle")
    saturation: float = Field(0.2, ge=0, le=1, description="largest change of saturation, share")
    brightness: float = Field(0.2, ge=0, le=1, description="largest change of brightness, share")
    mosaic: float = Field(0.0, ge=0, le=1, description="probability of a picture made from four")
    mosaic_off_epochs: int = Field(10, ge=0, description="last epochs without mosaic")


def default_augmentation(role: Role, free_rotation: bool) -> Augmentation:
    """What is legal for a role; what of it was measured is in docs/detector_training.md.

    Mirror images of pseudo-views help although views are always drawn from the sensor's side: without them small sets
    are learnt by heart. Objects in free rotation occur turned in every way, so their views may be turned too.
    """
    if role == "image":
        return Augmentation(flip_horizontal=0.5, scale=0.3, saturation=0.5, brightness=0.4)
    return Augmentation(flip_horizontal=0.5, flip_vertical=0.5 if free_rotation else 0.0, quarter_turns=free_rotation)


class TrainingConfig(BaseModel):
    """Settings of a training run; docs/detector_training.md says which defaults were measured, and how."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: str = Field("yolo11n", description="an ultralytics detection model: yolo11n, yolov8s, yolov5nu, yolo26n ...")
    pretrained: Literal["auto", "never"] | Path = Field(
        "auto",
        description="auto: published weights where they are found or can be downloaded; never: random weights; "
        "or a weights file to start from",
    )
    image_size_px: int = Field(224, ge=32, le=2048, multiple_of=32, description="longer side of a picture, pixels")
    epochs: int | None = Field(
        None, ge=1, description="passes over the pictures; None: as many as make `pictures_seen`"
    )
    pictures_seen: int = Field(4000, ge=1, description="length of a run whose epochs are not given, pictures")
    batch: int = Field(16, ge=2, description="pictures a step")
    patience: int = Field(0, ge=0, description="stop after this many epochs without a better measurement; 0: never")
    measure_every: int | None = Field(None, ge=1, description="epochs between measurements; None: about 12 in a run")

    optimizer: Literal["MuSGD", "AdamW", "SGD"] = "MuSGD"
    learning_rate: float = Field(0.01, gt=0, description="at its highest (AdamW likes 0.002)")
    final_learning_rate: float = Field(0.01, gt=0, le=1, description="at the end, share of the highest")
    momentum: float = Field(0.9, ge=0, lt=1)
    weight_decay: float = Field(0.0005, ge=0)
    warmup_epochs: float = Field(1.0, ge=0, description="the learning rate rises over these")
    box_gain: float = Field(7.5, gt=0, description="weight of the box overlap loss")
    class_gain: float = Field(0.5, gt=0, description="weight of the class loss")
    edge_gain: float = Field(1.5, gt=0, description="weight of the loss on each edge's distance")

    free_rotation: bool = Field(False, description="objects turn freely, so that turned pseudo-views are real ones")
    augmentation: Augmentation | None = Field(None, description="None: what suits the role")
    seed: int = Field(0, ge=0)
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1, mps")
    download_timeout_s: float = Field(60.0, gt=0, description="longest wait for published weights, seconds")

    def augmentation_for(self, role: Role) -> Augmentation:
        """The configured augmentation, or what suits the role."""
        return self.augmentation or default_augmentation(role, self.free_rotation)

    def epochs_for(self, images: int) -> int:
        """Epochs of a run over that many training pictures; at least 10 and at most 300 where they are not given."""
        return self.epochs or min(max(round(self.pictures_seen / images), 10), 300)


class DetectorConfig(BaseModel):
    """Settings of a trained detector at work; what runs it (device, backend, threads) is not in its fingerprint."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    image_size_px: int = Field(
        ge=32, description="the longer side of a picture is scaled to this; best what it was trained with; pixels"
    )
    confidence: float = Field(
        0.05, ge=0, le=1, description="boxes with a lower score are left out; low, because the 3D method weighs them"
    )
    iou: float = Field(0.6, ge=0, le=1, description="of two boxes of a class that overlap more (IoU), the better stays")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1, mps")
    backend: Backend = Field(
        "auto",
        description="what runs the network; auto: the fastest that answers as torch does; fastest: also in bfloat16",
    )
    threads: int | None = Field(None, ge=1, description="of the processor; None: all cores that the process may use")
