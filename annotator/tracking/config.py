"""How boxes are linked and smoothed."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TrackingConfig(BaseModel):
    """Lengths are shares of an object's longest side, times are frames (`frame_times`).

    Attributes:
        reach: how far from where its motion leads an object may be found, a frame.
        reach_new: the same of an object that was seen once and whose motion is not known.
        most_frames: of an object that was not found for a while, `reach` grows for so many frames.
        max_gap: frames after which an object that was not found is another one.
        max_size_ratio: by how much two boxes of one object may differ along a side.
        motion_boxes: the last boxes of an object that its motion follows from.
        window: boxes so many frames before and after one smooth its rotation.
        change_ratio: a side changes in time where its lengths' successive differences, squared, are on average below so
            many variances (2 for independent values); it then has no single length.
        least_for_change: boxes that it takes to say so.
        reviewed_weight: how many proposals a reviewed box counts for.
        least_motion: path of an object, in longest sides, from which on its motion says where its front is.
        least_along: mean cosine between motion and length axis from which on an object moves forward or backward.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach: float = Field(0.5, gt=0)
    reach_new: float = Field(1.0, gt=0)
    most_frames: float = Field(3.0, ge=1)
    max_gap: float = Field(5.0, ge=1)
    max_size_ratio: float = Field(2.5, gt=1)
    motion_boxes: int = Field(4, ge=2)
    window: float = Field(2.0, ge=0)
    change_ratio: float = Field(0.7, ge=0, le=2)
    least_for_change: int = Field(5, ge=3)
    reviewed_weight: float = Field(4.0, ge=1)
    least_motion: float = Field(0.5, gt=0)
    least_along: float = Field(0.7, gt=0, le=1)
