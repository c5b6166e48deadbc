"""Makes a project with proposed labels from a folder of frames, for review in the workbench. Writes 04_labels.png."""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

import annotator


def label(folder: Path, detector: annotator.Detector, project_folder: Path) -> None:
    """Adds the recording and proposes boxes for all its frames; when called again, only for new frames."""
    if project_folder.exists():
        project = annotator.open_project(project_folder)
    else:
        project = annotator.create_project(project_folder, classes=["hand"], rotation="free")
    with project:
        recording = project.add(folder, labels=False)
        done = project.annotate(image_detector=detector, view_detector=detector)
        print(f"{done.done} frames done, {done.skipped} were done before, {done.failures} failed")
        pictures = []
        for stored in project.frames(recording.name):
            labels = project.labels(stored)
            print(f"{recording.name}/{stored.key}: " + ", ".join(f"{x.label} {x.score:.2f} {x.state}" for x in labels))
            pictures.append(annotator.draw_boxes(project.read(stored), labels))
        cv2.imwrite("04_labels.png", np.hstack(pictures)[..., ::-1])


with TemporaryDirectory() as temporary:
    # For your own recording: python 04_label_a_folder.py FOLDER, and replace perfect_detector with your detector.
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary) / "room"
    if not folder.exists():
        annotator.generate_recording(folder, "hands", frames=3, width_px=320, height_px=240)
    detector = annotator.perfect_detector(annotator.open_recording(folder))
    for _ in range(2):
        label(folder, detector, Path(temporary) / "hands")
