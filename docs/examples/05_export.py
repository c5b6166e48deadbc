"""Exports labels to the formats of other tools, and reads them again. Prints a table."""

from pathlib import Path
from tempfile import TemporaryDirectory

import annotator

with TemporaryDirectory() as temporary:
    folder = Path(temporary)
    annotator.generate_recording(folder / "room", "people", frames=2, width_px=320, height_px=240)
    with annotator.create_project(folder / "rooms", classes=["person"]) as project:
        # the recording comes with 3D boxes, which become reviewed labels
        project.add(folder / "room")
        frames = {f"room/{stored.key}": project.read(stored) for stored in project.frames()}
        labels = {f"room/{stored.key}": project.labels(stored) for stored in project.frames()}
        print(f"{'format':<12}{'frames':>8}{'boxes':>8}{'least IoU':>12}")
        # this camera looks down, and KITTI's boxes cannot be tilted; report.losses lists what a format cannot hold
        for format in ("rcv", "kitti", "openlabel", "labelcloud", "nuscenes"):
            report = project.export(folder / format, format)
            again = annotator.read_labels(folder / format, format)
            worst = min(
                max(annotator.iou_3d(label.box, truth.box) for truth in again.truths(name, frames[name]))
                for name in again.frames
                for label in labels[name]
            )
            print(f"{format:<12}{report.frames:>8}{report.objects:>8}{worst:>12.4f}")

    # without a project: a boxes.json, which may be put into any RGB-D folder
    annotator.write_labels(folder / "boxes.json", labels)
    print("boxes.json: " + ", ".join(annotator.read_labels(folder / "boxes.json").frames))
