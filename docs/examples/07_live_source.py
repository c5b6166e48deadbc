"""3D boxes for the frames of your own live source, a generator. Writes 07_live.png."""

import time
from collections.abc import Iterator
from tempfile import TemporaryDirectory

import cv2

import annotator

with TemporaryDirectory() as folder:
    recording = annotator.generate_recording(f"{folder}/room", "hands", frames=6, width_px=320, height_px=240)
    pictures = [recording.frame(i) for i in range(len(recording))]
    detector = annotator.perfect_detector(recording)


def camera(rate_hz: float = 10.0) -> Iterator[annotator.Frame]:
    """Simulates a camera: yields the newest frame and drops those in between."""
    begin, last = time.perf_counter(), -1
    while (newest := int((time.perf_counter() - begin) * rate_hz)) < 20:
        if newest > last:
            last = newest
            sample = pictures[newest % len(pictures)]
            # replace these with the arrays of your camera's driver
            key, depth = sample.key, sample.depth_m
            assert depth is not None
            yield annotator.frame_from_rgbd(sample.rgb, depth, sample.camera, key=key, index=newest)
        time.sleep(0.005)


for detected in annotator.watch(camera(), image_detector=detector, view_detector=detector, rotation="free"):
    boxes = detected.found.proposals
    milliseconds = round(detected.detect_s * 1000)
    print(f"frame {detected.frame.index}: {len(boxes)} boxes in {milliseconds} ms, {detected.seeded} warm starts")
    picture = annotator.draw_boxes(detected.frame, boxes)
cv2.imwrite("07_live.png", picture[..., ::-1])
