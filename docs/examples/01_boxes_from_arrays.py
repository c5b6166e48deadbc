"""3D boxes from an RGB image, a depth image and given 2D boxes. Writes 01_boxes.png."""

from tempfile import TemporaryDirectory

import cv2

import annotator

with TemporaryDirectory() as folder:
    seen = annotator.generate_recording(f"{folder}/room", "hands", frames=1).frame(0)

# In place of your own arrays: uint8 (H, W, 3), float (H, W) in metres, and the camera matrix (3, 3).
rgb, depth_m, K = seen.rgb, seen.depth_m, seen.camera.matrix
assert depth_m is not None
frame = annotator.frame_from_rgbd(rgb, depth_m, K, key="my first frame")

hands = [annotator.Box2D("hand", 169, 64, 356, 195), annotator.Box2D("hand", 389, 199, 511, 349)]
# The view detector boxes the object on pseudo-views. This one needs no training, but works only for isolated objects.
found = annotator.propose(frame, image_boxes=hands, view_detector=annotator.NearestCluster("hand"), rotation="free")
for each in found.proposals:
    print(f"{each.label}: centre {each.box.center_m.round(3)} m, size {each.box.size_m.round(3)} m, {each.score:.2f}")
for lost in found.lost:
    print(f"{lost.label}: no box, {lost.trace[-1].stop.value}")

cv2.imwrite("01_boxes.png", annotator.draw_boxes(frame, [*hands, *found.proposals])[..., ::-1])
