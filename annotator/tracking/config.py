"""The settings of linking and smoothing."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TrackingConfig(BaseModel):
    """Settings; lengths are shares of an object's longest side, times are in frames (`frame_times`).

    Attributes:
        reach: maximum distance from the predicted position, per frame.
        reach_new: the same for an object with only one box, whose motion is unknown.
        most_frames: maximum number of missed frames over which `reach` grows.
        max_gap: a track ends after this many missed frames.
        max_size_ratio: maximum ratio between a side of two boxes of one object.
        motion_boxes: number of last boxes from which the motion is estimated.
        window: boxes within this many frames before and after a box smooth its rotation.
        change_ratio: if the mean squared successive difference of a side's lengths is below this multiple of their
            variance (2 for independent values), the side varies in time and gets no common length.
        least_for_change: minimum number of boxes for this test.
        reviewed_weight: weight of a reviewed box; a proposal has 1.
        least_motion: minimum distance travelled, in longest sides, for the motion to determine the front.
        least_along: minimum mean cosine between motion and length axis to count as moving forward or backward.
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
