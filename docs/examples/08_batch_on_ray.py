"""Batch annotation on a Ray cluster, here two workers on this machine (scripts/setup ray). Prints a table."""

from pathlib import Path
from tempfile import TemporaryDirectory

import annotator

# Address of a cluster: HOST:PORT, or auto. All its machines must be able to read the recordings (docs/cluster.md).
ADDRESS = None

with TemporaryDirectory() as temporary:
    folder = Path(temporary)
    recording = annotator.generate_recording(folder / "room", "hands", frames=8, width_px=320, height_px=240)
    # Sent to the workers. Not needed for a project with trained detectors.
    detector = annotator.perfect_detector(recording)
    with annotator.create_project(folder / "hands", classes=["hand"], rotation="free") as project:
        project.add(folder / "room", labels=False)
        done = project.annotate(
            image_detector=detector, view_detector=detector, engine="ray", workers=2, address=ADDRESS
        )
        print(f"{done.done} frames, {done.proposals} boxes, {done.failures} failed, {done.seconds:.1f} s")
        for stored in project.frames():
            boxes = (" x ".join(f"{100 * side:.1f}" for side in label.box.size_m) for label in project.labels(stored))
            print(f"{stored.key}  " + "  ".join(f"{size} cm" for size in boxes))
