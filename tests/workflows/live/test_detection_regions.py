"""The image regions in which the detector runs while objects are tracked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import box_iou
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import RcvConfig
from annotator.rcv.starts import WarmStart
from annotator.types import Box2D, Camera, Frame, Image, OrientedBox, PointCloud, Region
from annotator.workflows.live.detection import WHOLE_EVERY, RegionDetection, regions_around

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
CONFIG = RcvConfig()


def frame() -> Frame:
    cloud = PointCloud(np.zeros((0, 3), np.float32))
    return Frame("0", 0, CAMERA, np.zeros((480, 640, 3), np.uint8), cloud)


def seed(x_m: float, y_m: float = 0.0, size_m: float = 0.1, label: str = "hand") -> WarmStart:
    return WarmStart(label, OrientedBox.at(RigidTransform.from_translation([x_m, y_m, 1.0]), np.full(3, size_m)))


def outline(of: WarmStart) -> Box2D:
    found = box_on_image(CAMERA, of.box, of.label)
    assert found is not None
    return found


class KnownBoxes:
    """A detector with given boxes that records its images."""

    labels, fingerprint = ("hand",), "known"

    def __init__(self, *boxes: Box2D) -> None:
        self.boxes = list(boxes)
        self.asked: list[Image] = []

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        self.asked += images
        return [[box for whole in self.boxes if (box := on_part(image, whole))] for image in images]

    @property
    def regions(self) -> list[bool]:
        """For each image since the last call: whether it was a region."""
        asked, self.asked = self.asked, []
        return [isinstance(image, Region) for image in asked]


def on_part(image: Image, box: Box2D) -> Box2D | None:
    """A box on a region, clipped to its border."""
    x, y = (image.x_px, image.y_px) if isinstance(image, Region) else (0, 0)
    height, width = image.rgb.shape[:2]
    edges = np.array(box.xyxy) - (x, y, x, y)
    low, high = np.clip(edges.reshape(2, 2), -0.5, [width - 0.5, height - 0.5])
    return None if (high - low < 1).any() else Box2D(box.label, *low.tolist(), *high.tolist(), box.score)


def shifted(box: Box2D, x_px: float, **other: object) -> Box2D:
    values = {"label": box.label, "score": 0.9} | other
    return Box2D(x_min=box.x_min + x_px, y_min=box.y_min, x_max=box.x_max + x_px, y_max=box.y_max, **values)


def tracking(*boxes: Box2D) -> tuple[KnownBoxes, RegionDetection]:
    """A detector that knows boxes, and has searched the whole of a first image for them."""
    known = KnownBoxes(*boxes)
    image_detection = RegionDetection(known)
    image_detection.boxes(frame(), (), CONFIG)
    return known, image_detection


def test_a_tracked_object_is_searched_in_a_region_around_its_last_position() -> None:
    known = KnownBoxes(shifted(outline(seed(0.0)), 12.0))
    image_detection = RegionDetection(known)
    whole = image_detection.boxes(frame(), (), CONFIG)
    followed = image_detection.boxes(frame(), (seed(0.0),), CONFIG)
    assert known.regions == [False, True]
    assert whole == known.boxes
    assert followed[0].xyxy == pytest.approx(whole[0].xyxy)
    assert (followed[0].label, followed[0].score) == ("hand", 0.9)


def test_new_objects_are_found_when_the_whole_image_is_searched_again() -> None:
    known = KnownBoxes(outline(seed(0.0)), outline(seed(0.4)))
    image_detection = RegionDetection(known)
    found = [len(image_detection.boxes(frame(), (seed(0.0),), CONFIG)) for _ in range(2 * WHOLE_EVERY)]
    assert found == ([2] + [1] * (WHOLE_EVERY - 1)) * 2
    assert known.regions == ([False] + [True] * (WHOLE_EVERY - 1)) * 2


@pytest.mark.parametrize(
    "seen",
    [
        pytest.param([], id="not found"),
        pytest.param([shifted(outline(seed(0.0)), 40.0)], id="too far away"),
        pytest.param([shifted(outline(seed(0.0)), 0.0, score=0.1)], id="low score"),
        pytest.param([shifted(outline(seed(0.0)), 0.0, label="foot")], id="another class"),
    ],
)
def test_an_object_not_found_in_its_region_is_searched_in_the_whole_image(seen: list[Box2D]) -> None:
    known, image_detection = tracking(*seen)
    known.boxes = seen
    for _ in range(WHOLE_EVERY):
        assert image_detection.boxes(frame(), (seed(0.0),), CONFIG) == seen
    assert known.regions == [False, True, *[False] * WHOLE_EVERY], "regions are not used again at once"
    known.boxes = [outline(seed(0.0))]
    image_detection.boxes(frame(), (seed(0.0),), CONFIG)
    assert known.regions == [True]


def test_an_object_cut_off_by_its_region_is_searched_in_the_whole_image() -> None:
    near = seed(0.0, size_m=0.36)
    for x_px, regions in ((40.0, [True]), (50.0, [True, False])):
        moved = shifted(outline(near), x_px)
        assert box_iou(moved, outline(near)) > 0.5
        known, image_detection = tracking(moved)
        (found,) = image_detection.boxes(frame(), (near,), CONFIG)
        assert found.xyxy == pytest.approx(moved.xyxy)
        assert known.regions == [False, *regions]


def test_if_two_regions_find_the_same_object_the_whole_image_is_searched() -> None:
    known, image_detection = tracking(outline(seed(0.0)))
    assert image_detection.boxes(frame(), (seed(0.0), seed(0.02)), CONFIG) == known.boxes
    assert known.regions == [False, True, True, False]
    # those of two classes may be there both
    known, image_detection = tracking(outline(seed(0.0)), outline(seed(0.02, label="foot")))
    found = image_detection.boxes(frame(), (seed(0.0), seed(0.02, label="foot")), CONFIG)
    assert [box.label for box in found] == ["hand", "foot"]
    assert known.regions == [False, True, True]


@pytest.mark.parametrize(
    ("box", "place"),
    [
        (Box2D("a", 300.0, 200.0, 340.0, 240.0), (200, 100, 240, 240)),
        (Box2D("a", 300.0, 200.0, 500.0, 240.0), (240, 60, 320, 320)),
        (Box2D("a", 600.0, 0.0, 639.5, 30.0), (400, 0, 240, 240)),
        (Box2D("a", 0.0, 0.0, 600.0, 470.0), (0, 0, 640, 480)),
    ],
)
def test_regions_contain_their_box_and_are_within_the_image(box: Box2D, place: tuple[int, ...]) -> None:
    (region,) = regions_around(frame(), [box])
    assert (region.x_px, region.y_px, region.width_px, region.height_px) == place
    assert region.rgb.shape == (place[3], place[2], 3)
    assert region.share == max(place[2:]) / 640


def test_objects_at_the_border_of_the_image_are_tracked() -> None:
    at_edge = Box2D("hand", -0.5, 200.0, 40.0, 250.0, 0.9)
    known, image_detection = tracking(at_edge)
    assert image_detection.boxes(frame(), (seed(-0.6),), CONFIG) == [at_edge]
    assert known.regions == [False, True]
