"""Every threshold of Recursive Cross-View, each with its unit.

Numbers that are no settings, such as how densely a search looks, are constants beside their code.
"""

from __future__ import annotations

import math
from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

from annotator.types import BoxKind

# Part of what decides whether a frame has been done: raise it when the same settings would give other boxes.
REVISION = 6


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

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    size_px: int = Field(64, ge=32, le=2048, description="longer side of a pseudo-view, pixels")
    deep_size_px: int = Field(
        224, ge=32, le=2048, description="the same of the first step's views, where a frustum is deep, pixels"
    )
    deep: float = Field(
        2.0, gt=0, description="a frustum that is so many times as deep as wide and high shows its object small, factor"
    )
    points_per_px: float = Field(
        4.0, gt=0, description="clouds with more points for each pixel of a square picture are drawn thinned out"
    )
    padding: float = Field(0.06, ge=0, le=1, description="empty border on each side, share of the shown extent")
    min_extent_m: float = Field(0.02, gt=0, description="a view never shows less than this, metres")
    max_splat_px: int = Field(9, ge=1, le=31, description="largest square that one point is drawn as, pixels")


class AxesConfig(BaseModel):
    """How axes are found in a cloud and its normals."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min_flatness: float = Field(
        0.05, ge=0, lt=1, description="relative gap of neighbouring eigenvalues below which they fix no axes"
    )
    normal_neighbours: int = Field(
        16, ge=3, le=256, description="neighbours that a normal is estimated from without a depth image, points"
    )
    min_normals: int = Field(30, ge=3, description="fewer usable normals fall back to eigenvectors, points")
    max_normals: int = Field(2000, ge=16, description="of more normals, so many are clustered, points")
    kmeans_clusters: int = Field(6, ge=1, le=16, description="clusters of point normals")
    seed: int = Field(0, ge=0, description="of K-means")
    steep_normal_rad: float = Field(
        math.radians(25),
        ge=0,
        le=math.pi / 2,
        description="upright: a normal nearer to the vertical is a floor's or a table top's and fixes no side, radians",
    )
    min_second_angle_rad: float = Field(
        math.radians(30),
        gt=0,
        le=math.pi / 2,
        description="free: a cluster nearer to the major axis cannot give the second one, radians",
    )


class FitConfig(BaseModel):
    """The robust fit of one box through measured intervals."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    edge_noise: float = Field(0.02, gt=0, description="expected error of a detected edge, share of the view's extent")
    cut_doubt: float = Field(
        3.0, ge=1, description="an edge that its picture cut off counts as so many times less certain, factor"
    )
    huber_sigmas: float = Field(
        1.5, gt=0, description="an edge that is further off weighs less, multiples of its expected error"
    )
    min_size_m: float = Field(1e-3, gt=0, description="a box with a side this short is no fit, metres")
    min_determinacy: float = Field(
        0.02,
        gt=0,
        lt=1,
        description="smallest singular value of the equations, each unknown scaled to one; below, they fix no box",
    )


class ConsensusConfig(BaseModel):
    """The axis hypotheses of a consensus step, and which of their boxes may win where silhouettes were taught."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    upright_hypotheses: int = Field(4, ge=2, le=16, description="yaws of a wide step, over a quarter turn")
    free_hypotheses: int = Field(12, ge=4, le=64, description="orientations of a wide step")
    refine_hypotheses: int = Field(3, ge=1, le=16, description="hypotheses of a step around the last fit")
    refine_steps: int = Field(
        1, ge=0, le=16, description="steps around the last fit, after the wide one; more for what a picture cuts off"
    )
    refine_spread_rad: float = Field(0.35, gt=0, description="how far these lie from the last fit, radians")
    whole_share: float = Field(
        0.95,
        ge=0,
        le=1,
        description="a silhouette's box with less than this share of the median's points has lost a part of the object",
    )
    silhouette_margin: float = Field(
        0.03, ge=0, le=1, description="points this share of a box's size outside still count as held (detector's blur)"
    )


class WarmConfig(BaseModel):
    """How an object starts from a box that it had a moment ago, and when that box is dropped."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min_image_iou: float = Field(
        0.3, gt=0, le=1, description="IoU on the image of the seed, and of what came of it, with the image box"
    )
    room: float = Field(
        0.2, ge=0, le=2, description="points this share of the seed's longest side outside are looked at, and no more"
    )
    spread_rad: float = Field(
        0.35, gt=0, le=1.5, description="free: how far the hypotheses lie from the seed's axes, radians"
    )
    min_seen: float = Field(0.6, ge=0, le=1, description="share of the first step's views that show the object")
    max_size_ratio: float = Field(1.5, ge=1, description="a side that differs more is another object's, factor")
    min_iou: float = Field(
        0.4, ge=0, le=1, description="IoU with the seed, centre on centre, below which it is another object's"
    )
    settled_iou: float = Field(
        0.8, ge=0, le=1, description="IoU with the seed, centre on centre, from which one step is enough"
    )
    seed_doubt: float = Field(
        0.05, gt=0, description="how far an end of the seed may be off by now, share of its mean side; small trusts it"
    )
    max_steps: int = Field(2, ge=1, le=20, description="step limit from a seed")


class RcvConfig(BaseModel):
    """Settings of the recursion. Defaults are the ones that measured best (docs/benchmarks.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    strategy: Strategy = Strategy.CONSENSUS
    orientation: Orientation = Orientation.FREE
    box_kind: BoxKind = Field(BoxKind.BOX, description="what the view detector's boxes measure")
    view: ViewConfig = ViewConfig()
    axes: AxesConfig = AxesConfig()
    consensus: ConsensusConfig = ConsensusConfig()
    fit: FitConfig = FitConfig()
    warm: WarmConfig = WarmConfig()

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
    stranger_weight: float = Field(
        0.1, ge=0, description="what a detection away from the last box still counts, against 1 for one that fits it"
    )
    border_px: float = Field(1.0, ge=0, description="an edge this near to the picture's border was cut off, pixels")
    cut_room: float = Field(1.4, ge=1, description="pictures after a cut-off show so many times the box, factor")
    keep_margin: float = Field(0.03, ge=0, le=1, description="points this share of the box's size outside are kept")
    keep_margin_view: float = Field(
        0.04, ge=0, le=1, description="points this share of the view's extent outside are kept (the detector's blur)"
    )
    min_image_agreement: float = Field(
        0.05,
        ge=0,
        le=1,
        description="IoU on the image with the image box, below which a further object of a frustum is dropped",
    )
    coarse_box: bool = Field(
        False,
        description="propose a coarse box for a lost object: its last one, or that around its frustum's points",
    )
    nms_iou: float = Field(0.3, ge=0, le=1, description="of two boxes of a class that overlap more, the better stays")
