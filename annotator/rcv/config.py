"""The settings of Recursive Cross-View that somebody may want to change, with units and bounds.

Thresholds chosen by measurements, and numbers that only affect computing time, are constants beside their code.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from annotator.types import BoxKind

# Typical sizes of classes: of those in the settings, and of well-known ones by name.
#
# Sources of the means: KITTI (Geiger et al., CVPR 2012) and nuScenes (Caesar et al., CVPR 2020) for traffic; SUN
# RGB-D's furniture as averaged for VoteNet (Qi et al., ICCV 2019); for hands, relaxed and as fists, common
# anthropometry. Spreads are rough.


Side = Annotated[float, Field(gt=0)]
Spread = Annotated[float, Field(gt=0, le=2)]


class TypicalSize(BaseModel):
    """The typical size of a class.

    Attributes:
        size_m: sides, metres; the last one is the height of upright boxes, and the order of the others does not matter.
        spread: standard deviation of the logarithm of each side; 0.1 means about 10 %.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    label: str
    size_m: tuple[Side, Side, Side]
    spread: tuple[Spread, Spread, Spread]


# length, width and height in metres; their spreads; names
_KNOWN: tuple[tuple[tuple[float, float, float], tuple[float, float, float], str], ...] = (
    ((3.9, 1.63, 1.55), (0.12, 0.07, 0.08), "car"),
    ((4.8, 1.9, 2.1), (0.15, 0.07, 0.12), "van"),
    ((7.0, 2.5, 2.9), (0.35, 0.1, 0.2), "truck"),
    ((11.0, 2.9, 3.5), (0.2, 0.07, 0.1), "bus"),
    ((12.0, 2.9, 3.9), (0.3, 0.1, 0.15), "trailer"),
    ((6.5, 2.8, 3.2), (0.3, 0.15, 0.15), "construction_vehicle"),
    ((16.0, 2.5, 3.5), (0.15, 0.07, 0.07), "tram"),
    ((0.85, 0.65, 1.75), (0.25, 0.15, 0.07), "pedestrian"),
    ((0.8, 0.6, 1.27), (0.2, 0.15, 0.1), "person_sitting"),
    ((1.77, 0.65, 1.73), (0.1, 0.15, 0.07), "cyclist bicyclist motorcyclist"),
    ((1.7, 0.6, 1.2), (0.1, 0.2, 0.15), "bicycle"),
    ((2.1, 0.8, 1.4), (0.12, 0.2, 0.15), "motorcycle"),
    ((2.4, 0.5, 1.0), (0.3, 0.2, 0.15), "barrier"),
    ((0.41, 0.41, 1.07), (0.25, 0.25, 0.25), "traffic_cone"),
    ((0.16, 0.1, 0.07), (0.25, 0.2, 0.25), "hand"),
    ((2.1, 1.6, 0.95), (0.15, 0.25, 0.3), "bed"),
    ((1.3, 0.8, 0.72), (0.4, 0.35, 0.2), "table"),
    ((1.35, 0.7, 0.75), (0.3, 0.25, 0.2), "desk"),
    ((1.9, 0.92, 0.85), (0.3, 0.15, 0.15), "sofa couch"),
    ((0.6, 0.55, 0.83), (0.2, 0.2, 0.2), "chair"),
    ((0.7, 0.45, 0.75), (0.15, 0.15, 0.15), "toilet"),
    ((1.0, 0.53, 1.15), (0.35, 0.2, 0.35), "dresser"),
    ((0.6, 0.5, 0.65), (0.3, 0.25, 0.25), "night_stand"),
    ((1.07, 0.4, 1.65), (0.4, 0.3, 0.3), "bookshelf"),
    ((1.5, 0.77, 0.5), (0.2, 0.15, 0.2), "bathtub"),
)
WELL_KNOWN: Mapping[str, TypicalSize] = {
    name: TypicalSize(label=name, size_m=size, spread=spread)
    for size, spread, names in _KNOWN
    for name in names.split()
}


def typical_size(label: str, given: Iterable[TypicalSize] = ()) -> TypicalSize | None:
    """The typical size of a class: the first given one, else that of a well-known class of this name, else None.

    Case, and spaces or hyphens in place of underscores, make no difference.
    """
    name = _normalised(label)
    own = next((size for size in given if _normalised(size.label) == name), None)
    return own or WELL_KNOWN.get(name)


def _normalised(label: str) -> str:
    return label.strip().lower().replace(" ", "_").replace("-", "_")


# Part of the fingerprint of annotated frames. Increase it when the same settings give different boxes.
REVISION = 6


# The two classes of a class-agnostic view detector, by what a box measures.
AGNOSTIC_LABELS = {BoxKind.BOX: "whole", BoxKind.SILHOUETTE: "seen"}


# With fewer points, the recursion ends.
MIN_POINTS = 5


class Strategy(StrEnum):
    """How the projection axes of a step are found, from the simplest to the most complex strategy."""

    CAMERA = "camera"
    EIGENVECTORS = "eigenvectors"
    NORMALS = "normals"
    CONSENSUS = "consensus"


class Orientation(StrEnum):
    """UPRIGHT keeps one box axis parallel to gravity; FREE allows any rotation."""

    UPRIGHT = "upright"
    FREE = "free"


class RcvConfig(BaseModel):
    """Settings of the recursion. The defaults gave the best results (docs/benchmarks.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    strategy: Strategy = Strategy.CONSENSUS
    orientation: Orientation = Orientation.FREE
    box_kind: BoxKind = Field(BoxKind.BOX, description="what the view detector's boxes measure")
    image_box_kind: BoxKind = Field(BoxKind.BOX, description="what the boxes on the camera image enclose")
    view_px: int = Field(64, ge=32, le=2048, description="longer side of a pseudo-view, pixels")
    typical_sizes: tuple[TypicalSize, ...] = Field(
        (), description="typical sizes of classes, in place of those of reviewed boxes and of well-known classes"
    )
    reviewed_sizes: tuple[TypicalSize, ...] = Field(
        (), description="typical sizes of a project's classes, from its reviewed boxes"
    )
    use_typical_sizes: bool = Field(
        True, description="whether a class-agnostic detector's objects start from boxes of their class's typical size"
    )
    class_agnostic: bool = Field(
        False, description="whether the view detector measures the object of a crop, whatever its class"
    )
    trained: bool = Field(False, description="whether the view detector was trained on objects of the project")

    max_steps: int = Field(
        5, ge=1, le=20, description="maximum number of steps, including the first one along the camera axes"
    )
    refine_steps: int = Field(
        1,
        ge=0,
        le=16,
        description="consensus: refinement steps after the wide step; cut-off objects get more, up to `max_steps`",
    )

    min_image_score: float = Field(0.25, ge=0, le=1, description="image detections with a lower score are ignored")
    min_view_score: float = Field(0.05, ge=0, le=1, description="view detections with a lower score are ignored")
    coarse_box: bool = Field(
        False,
        description="propose a coarse box for a lost object: its last box, or one around the frustum's points",
    )

    def for_detector(
        self, kind: BoxKind, class_agnostic: bool = False, image_kind: BoxKind = BoxKind.BOX, trained: bool = False
    ) -> RcvConfig:
        """The same settings for a view detector. Only this method sets these four settings.

        Args:
            kind: what its boxes measure.
            class_agnostic: whether it measures the object of a crop, whatever its class.
            image_kind: what the boxes on the camera image enclose.
            trained: whether it was trained on objects of the project; only matters if it is class-agnostic.
        """
        facts = {"box_kind": kind, "class_agnostic": class_agnostic, "image_box_kind": image_kind}
        return self.model_copy(update=facts | {"trained": class_agnostic and trained})

    @property
    def uses_typical_sizes(self) -> bool:
        """Whether objects whose class has a typical size start from boxes of this size."""
        return self.class_agnostic and self.box_kind is BoxKind.BOX and self.use_typical_sizes

    def typical_size(self, label: str) -> TypicalSize | None:
        """The typical size of a class, if it has one and it is used."""
        if not self.uses_typical_sizes:
            return None
        return typical_size(label, (*self.typical_sizes, *self.reviewed_sizes))

    def record(self) -> dict[str, Any]:
        """The settings as JSON values, for the record of a run; those that do not apply are left out.

        So a change of those does not annotate all frames again.
        """
        # Reviewed sizes change with every review, which is no reason to annotate all frames again.
        left_out: dict[str, Any] = {"orientation": True, "reviewed_sizes": True}
        if not self.uses_typical_sizes:
            left_out["typical_sizes"] = True
        if not (self.trained and self.uses_typical_sizes):
            left_out["trained"] = True
        if not self.class_agnostic:
            left_out |= {"class_agnostic": True, "use_typical_sizes": True}
        if self.image_box_kind is BoxKind.BOX or self.box_kind is BoxKind.SILHOUETTE:  # it changes nothing
            left_out["image_box_kind"] = True
        return self.model_dump(mode="json", exclude=left_out)
