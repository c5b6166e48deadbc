"""Every threshold of Recursive Cross-View, each with its unit."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

from annotator.types import BoxKind

# Part of what decides whether a frame has been done: raise it when the same settings would give other boxes.
REVISION = 1


class Strategy(StrEnum):
    """How the projection axes of a step are found; the order is from simple to rich."""

    CAMERA = "camera"
    EIGENVECTORS = "eigenvectors"
    NORMALS = "normals"
    CONSENSUS = "consensus"


class Orientation(StrEnum):
    """UPRIGHT holds one axis at gravity; FREE allows any rotation."""

    UPRIGHT = "upright"
    FREE = "free"


class ViewConfig(BaseModel):
    """How pseudo-views are drawn."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size_px: int = Field(224, ge=32, le=2048, description="longer side of a pseudo-view, pixels")
    padding: float = Field(0.06, ge=0, le=1, description="empty border on each side, share of the shown extent")
    min_extent_m: float = Field(0.02, gt=0, description="a view never shows less than this, metres")
    max_splat_px: int = Field(9, ge=1, le=31, description="largest square that one point is drawn as, pixels")


class RcvConfig(BaseModel):
    """Settings of the recursion. Defaults are the ones that measured best (docs/benchmarks.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    strategy: Strategy = Strategy.CONSENSUS
    orientation: Orientation = Orientation.FREE
    box_kind: BoxKind = Field(BoxKind.BOX, description="what the view detector's boxes measure")
    view: ViewConfig = ViewConfig()

    max_steps: int = Field(5, ge=1, le=20, description="step limit, the first (camera axes) included")
    min_points: int = Field(5, ge=1, description="a cloud with fewer points ends the recursion, points")
    axes_tolerance_rad: float = Field(0.02, gt=0, description="axes that turn less have converged, radians")
    box_tolerance: float = Field(
        0.03, gt=0, lt=1, description="a box with 1 - IoU to the last below this has converged"
    )

    min_image_score: float = Field(0.25, ge=0, le=1, description="image detections below are ignored")
    min_view_score: float = Field(0.05, ge=0, le=1, description="pseudo-view detections below are ignored")
    min_shared_overlap: float = Field(
        0.3, ge=0, le=1, description="1D IoU of front and side box on their shared axis for a pair, first step"
    )
    max_objects_per_frustum: int = Field(5, ge=1, description="pairs that survive the first step, objects")
    keep_margin: float = Field(0.03, ge=0, le=1, description="points this share of the box's size outside are kept")
    keep_margin_view: float = Field(
        0.04, ge=0, le=1, description="points this share of the view's extent outside are kept (the detector's blur)"
    )
    coarse_box: bool = Field(
        False,
        description="propose a coarse box for a lost object: its last one, or that around its frustum's points",
    )
    nms_iou: float = Field(0.3, ge=0, le=1, description="of two boxes of a class that overlap more, the better stays")

    kmeans_clusters: int = Field(6, ge=1, le=16, description="clusters of point normals")
    min_normals: int = Field(30, ge=3, description="fewer usable normals fall back to eigenvectors, points")
    min_flatness: float = Field(
        0.05, ge=0, lt=1, description="relative gap of neighbouring eigenvalues below which they fix no axes"
    )

    upright_hypotheses: int = Field(4, ge=2, le=16, description="yaws of a wide consensus step, over a quarter turn")
    free_hypotheses: int = Field(12, ge=4, le=64, description="orientations of a wide consensus step")
    refine_hypotheses: int = Field(3, ge=1, le=16, description="hypotheses of a step around the last fit")
    refine_spread_rad: float = Field(0.35, gt=0, description="how far these lie from the last fit, radians")
    edge_noise: float = Field(
        0.02, gt=0, description="expected error of a detected edge, share of the view's extent; scales the robust fit"
    )
    seed: int = Field(0, description="of K-means")
