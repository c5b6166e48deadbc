"""Objects put into other frames: their boxes, what they hide and what hides them, and where they may be put."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, box_surface, some_box

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.projection import inside_image, project
from annotator.rcv.pasting import objects as pasting
from annotator.rcv.pasting.image import draw_patch, image_patch
from annotator.rcv.pasting.objects import Cutout, PastedFrame, Target, can_paste, cut_objects, paste
from annotator.rcv.teach import TaughtObject
from annotator.synthetic.snapshots import snapshot
from annotator.types import Frame, PointCloud

# Generated frames of depth cameras and of LiDARs.
SEEDS = range(200, 216)
MARGIN = pasting.GROWN


class Scene:
    """A generated frame, its objects and what can be cut out of it."""

    def __init__(self, seed: int, upright: bool) -> None:
        shot = snapshot(seed)
        self.frame: Frame = shot.frame
        self.up = shot.frame.up if upright else None
        self.objects = tuple(TaughtObject(item.label, item.box) for item in shot.objects)
        self.cutouts = [cutout for cutout in cut_objects(self.frame, self.objects, self.up) if cutout is not None]

    @property
    def target(self) -> Target:
        return Target(self.frame, self.objects, (), self.up, pasting.SightGrid.of(self.frame))


Example = tuple[Scene, Cutout, PastedFrame]


@pytest.fixture(scope="module", params=[True, False], ids=["upright", "free"])
def examples(request: pytest.FixtureRequest) -> list[Example]:
    """Pasted objects in frames of both kinds of sensors."""
    rng = np.random.default_rng(0)
    scenes = [Scene(seed, request.param) for seed in SEEDS]
    found: list[Example] = []
    for scene in scenes:
        target = scene.target
        others = [cutout for other in scenes if other is not scene for cutout in other.cutouts]
        fitting = [cutout for cutout in others if can_paste(cutout, target)]
        for number in rng.permutation(len(fitting))[:25]:
            pasted = paste(fitting[number], target, rng)
            if pasted is not None:
                found.append((scene, fitting[number], pasted))
    is_lidar = {scene.frame.cloud.pixel_index is None for scene, _, _ in found}
    assert is_lidar == {True, False}
    assert len(found) >= 10
    return found


def own_points(pasted: PastedFrame) -> np.ndarray:
    return pasted.frame.cloud.xyz_m[pasted.objects[-1].points]


def test_the_box_of_a_pasted_object_contains_its_points(examples: list[Example]) -> None:
    for _, cutout, pasted in examples:
        box = pasted.objects[-1].box
        assert box.size_m == pytest.approx(cutout.box.size_m)
        assert contains(box, own_points(pasted), MARGIN * box.size_m.max() + 1e-4).all()
        assert len(own_points(pasted)) >= pasting.MIN_POINTS
        # the same points, moved rigidly
        local = (own_points(pasted) - box.center_m) @ box.rotation
        before = (pasted.source_m - cutout.box.center_m) @ cutout.box.rotation
        assert local == pytest.approx(before, abs=1e-4)


def test_an_object_is_never_put_nearer_and_hardly_turned_as_seen_from_the_camera(examples: list[Example]) -> None:
    for _, cutout, pasted in examples:
        old, new = cutout.box, pasted.objects[-1].box
        assert np.linalg.norm(new.center_m) >= np.linalg.norm(old.center_m)
        # the direction to the camera in the object's own axes
        before = -old.rotation.T @ old.center_m / np.linalg.norm(old.center_m)
        after = -new.rotation.T @ new.center_m / np.linalg.norm(new.center_m)
        # an upright object keeps its height, so it is also seen more or less from above
        limit = np.degrees(pasting.MOST_TURN_RAD) + (0.1 if cutout.up is None else 30)
        assert np.degrees(np.arccos(np.clip(before @ after, -1, 1))) <= limit
        if cutout.up is not None:
            assert abs(cutout.up @ old.rotation) == pytest.approx(abs(pasted.frame.up @ new.rotation), abs=1e-6)


def test_nothing_stays_visible_behind_a_pasted_object_and_it_is_hidden_by_what_is_nearer(
    examples: list[Example],
) -> None:
    for scene, _, pasted in examples:
        grid, before = scene.target.grid, {tuple(point) for point in scene.frame.cloud.xyz_m}
        is_new = np.array([tuple(point) not in before for point in pasted.frame.cloud.xyz_m])
        new, rest = pasted.frame.cloud.xyz_m[is_new], pasted.frame.cloud.xyz_m[~is_new]
        assert not grid.hides(new, rest).any()
        assert not grid.hides(scene.frame.cloud.xyz_m, new).any()
        assert inside_image(scene.frame.camera, project(scene.frame.camera, new)).all()
        # new are the object, and what it is connected to
        box = pasted.objects[-1].box
        assert contains(box, new, pasting.ATTACHED * box.size_m.max() + 1e-4).all()
        assert is_new[pasted.objects[-1].points].all()
    assert any(len(pasted.frame.cloud) - len(own_points(pasted)) < len(s.frame.cloud) for s, _, pasted in examples)
    assert any(pasted.visible < 1 for _, _, pasted in examples)


def test_a_pasted_object_meets_no_other_and_the_others_keep_their_points(examples: list[Example]) -> None:
    for scene, _, pasted in examples:
        assert len(pasted.objects) == len(scene.objects) + 1
        for before, after in zip(scene.objects, pasted.objects, strict=False):
            assert iou_3d(before.box, pasted.objects[-1].box) == 0
            had = contains(before.box, scene.frame.cloud.xyz_m).sum()
            assert pasting.MIN_VISIBLE * had <= after.points.sum() <= had
            assert not (after.points & pasted.objects[-1].points).any()
            assert contains(before.box, pasted.frame.cloud.xyz_m[after.points]).all()


def test_an_object_that_stood_on_the_ground_stands_on_it_again(examples: list[Example]) -> None:
    standing = [(s, c, p) for s, c, p in examples if c.ground_m is not None]
    assert standing or examples[0][1].up is None
    for scene, cutout, pasted in standing:
        box, up, xyz = pasted.objects[-1].box, pasted.frame.up, scene.frame.cloud.xyz_m
        away = xyz - box.center_m
        level = away - np.outer(away @ up, up)
        near = np.linalg.norm(level, axis=1) < 4.01 * np.linalg.norm(box.size_m)
        assert abs((away @ up)[near] + cutout.ground_m).min() < 0.1 * np.abs(up @ box.rotation) @ box.size_m


def test_cut_objects_leave_the_ground_behind() -> None:
    found = 0
    for seed in SEEDS:
        scene = Scene(seed, True)
        for cutout in scene.cutouts:
            if cutout.ground_m is not None:
                height = (cutout.cloud.xyz_m - cutout.box.center_m) @ cutout.up
                assert (height > -cutout.ground_m).all()
                found += 1
    assert found > 5


def test_an_object_that_the_image_or_something_nearer_cuts_is_not_cut_out() -> None:
    scene = next(s for s in (Scene(seed, True) for seed in SEEDS) if s.cutouts)
    item = next(o for o, c in zip(scene.objects, cut_objects(scene.frame, scene.objects, scene.up), strict=True) if c)
    camera, px = scene.frame.camera, project(scene.frame.camera, item.box.center_m[None])[0]
    narrow = replace(camera, width_px=max(int(px[0]), 1))
    rgb = scene.frame.rgb[:, : narrow.width_px]
    cloud = replace(scene.frame.cloud, pixel_index=None)
    assert cut_objects(replace(scene.frame, camera=narrow, rgb=rgb, depth_m=None, cloud=cloud), [item], scene.up) == [
        None
    ]
    xyz = cloud.xyz_m.copy()
    xyz[contains(item.box, xyz)] *= np.float32(0.3)
    assert cut_objects(replace(scene.frame, cloud=replace(cloud, xyz_m=xyz)), [item], scene.up) == [None]


def test_what_an_object_is_connected_to_comes_along_and_nothing_else() -> None:
    pose = some_box([0.0, 0.0, 1.0], [0, 0, 0], [0.2, 0.2, 0.2])
    hand = box_surface(pose, 1500, np.random.default_rng(0))
    arm = box_surface(some_box([0.3, 0, 1.0], [0, 0, 0], [0.4, 0.06, 0.06]), 1500, np.random.default_rng(1))
    wall = box_surface(some_box([0, 0, 1.25], [0, 0, 0], [1.0, 1.0, 0.01]), 3000, np.random.default_rng(2))
    cloud = PointCloud(np.concatenate([hand, arm, wall]).astype(np.float32))
    frame = Frame("0", 0, CAMERA, np.zeros((480, 640, 3), np.uint8), cloud)
    (cutout,) = cut_objects(frame, [TaughtObject("hand", pose)], None)
    assert cutout is not None
    assert cutout.cloud.xyz_m[:, 2].max() < 1.2
    along = cutout.cloud.xyz_m[:, 0]
    assert along.max() == pytest.approx(0.2, abs=0.02)
    assert (cutout.own == contains(pose, cutout.cloud.xyz_m, pasting.GROWN * 0.2)).all()
    assert cutout.own.sum() >= 1500


def test_the_same_seed_gives_the_same_frame(examples: list[Example]) -> None:
    scene, cutout, _ = examples[0]
    tries = [[paste(cutout, scene.target, np.random.default_rng(seed)) for seed in range(20)] for _ in range(2)]
    pairs = [(a, b) for a, b in zip(*tries, strict=True) if a is not None and b is not None]
    assert [a is None for a in tries[0]] == [b is None for b in tries[1]]
    assert pairs
    assert all((a.frame.cloud.xyz_m == b.frame.cloud.xyz_m).all() for a, b in pairs)
    assert len({a.objects[-1].box.center_m.tobytes() for a, _ in pairs}) == len(pairs)


def test_sensors_of_different_kinds_are_not_mixed(examples: list[Example]) -> None:
    scene, cutout, _ = examples[0]
    target = scene.target
    other = replace(target.grid, camera=None if target.grid.camera else scene.frame.camera)
    assert can_paste(cutout, target)
    assert not can_paste(cutout, replace(target, grid=other))
    assert not can_paste(cutout, replace(target, up=np.array([0.0, -1.0, 0.0]) if target.up is None else None))
    assert not can_paste(replace(cutout, cloud=replace(cutout.cloud, rgb=None)), target)


def test_an_object_is_drawn_where_its_points_are_and_nowhere_else(examples: list[Example]) -> None:
    drawn = 0
    for scene, cutout, pasted in examples:
        source = next(s for s in map(Scene, SEEDS, [cutout.up is not None] * len(SEEDS)) if holds(s, cutout))
        white = replace(source.frame, rgb=np.full_like(source.frame.rgb, 255))
        patch = image_patch(white, cutout)
        assert patch is not None
        black = replace(pasted, frame=replace(pasted.frame, rgb=np.zeros_like(pasted.frame.rgb)))
        image = draw_patch(patch, black)
        if image is None:
            continue
        drawn += 1
        px = np.rint(project(scene.frame.camera, own_points(pasted))).astype(int)
        lit = image[px[:, 1], px[:, 0], 0] > 0
        assert lit.mean() > 0.8
        reach = np.ptp(px, axis=0).max() * 0.25 + 4
        rows, columns = np.nonzero(image[..., 0])
        assert columns.min() > px[:, 0].min() - reach
        assert columns.max() < px[:, 0].max() + reach
        assert rows.min() > px[:, 1].min() - reach
        assert rows.max() < px[:, 1].max() + reach
        if drawn == 6:
            break
    assert drawn >= 3


def holds(scene: Scene, cutout: Cutout) -> bool:
    return any((item.box.center_m == cutout.box.center_m).all() for item in scene.objects)
