"""3D boxes from an RGB image, a depth image and given 2D boxes. Writes 01_boxes.png."""

from tempfile import TemporaryDirectory

import cv2

import annotator

with TemporaryDirectory() as folder:
    sample = annotator.generate_recording(f"{folder}/room", "hands", frames=1).frame(0)

# In place of your own arrays: uint8 (H, W, 3), float (H, W) in metres, and the camera matrix (3, 3).
rgb, depth_m, K = sample.rgb, sample.depth_m, sample.camera.matrix
assert depth_m is not None
frame = annotator.frame_from_rgbd(rgb, depth_m, K, key="my first frame")

hands = [annotator.Box2D("hand", 169, 64, 356, 195), annotator.Box2D("hand", 389, 199, 511, 349)]
# The view detector boxes the object on pseudo-views. This one needs no training, but works only for isolated objects.
result = annotator.propose(frame, image_boxes=hands, view_detector=annotator.NearestCluster("hand"), rotation="free")
for proposal in result.proposals:
    box = proposal.box
    print(f"{proposal.label}: centre {box.center_m.round(3)} m, size {box.size_m.round(3)} m, {proposal.score:.2f}")
for lost in result.lost:
    print(f"{lost.label}: no box, {lost.trace[-1].stop.value}")

cv2.imwrite("01_boxes.png", annotator.draw_boxes(frame, [*hands, *result.proposals])[..., ::-1])
