"""Your own 2D detector, here one that looks for skin near the camera. Writes 02_detected.png."""

from tempfile import TemporaryDirectory

import cv2
import numpy as np

import annotator

HAND_M, NEAR_M, LEAST_PX = 0.13, 0.75, 2000


def hands(frame: annotator.Frame) -> list[annotator.Box2D]:
    """The upper 13 cm of each connected patch of skin that is near the camera."""
    assert frame.depth_m is not None
    hue = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2HSV)[..., 0]
    skin = (hue < 20) & (frame.depth_m > 0) & (frame.depth_m < NEAR_M)
    count, patches = cv2.connectedComponents(cv2.medianBlur(skin.astype(np.uint8), 5))
    boxes = []
    for patch in range(1, count):
        y, x = np.nonzero(patches == patch)
        if len(y) >= LEAST_PX:
            length_px = HAND_M * frame.camera.fy / float(np.median(frame.depth_m[y, x]))
            x, y = x[y < y.min() + length_px], y[y < y.min() + length_px]
            boxes.append(annotator.Box2D("hand", x.min(), y.min(), x.max(), y.max(), score=0.9))
    return boxes


view_detector = annotator.NearestCluster("hand")
with TemporaryDirectory() as folder:
    recording = annotator.generate_recording(f"{folder}/room", "hands", frames=2)
    frames = [recording.frame(i) for i in range(len(recording))]
results = annotator.propose(frames, image_detector=hands, view_detector=view_detector, rotation="free")
for frame, result in zip(frames, results, strict=True):
    print(f"frame {frame.key}: {len(hands(frame))} 2D boxes, {len(result.proposals)} 3D boxes")
pictures = [annotator.draw_boxes(f, [*hands(f), *result.proposals]) for f, result in zip(frames, results, strict=True)]
cv2.imwrite("02_detected.png", np.hstack(pictures)[..., ::-1])
