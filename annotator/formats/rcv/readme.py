"""The README.md inside an `rcv` dataset, which describes the dataset without any other document."""

from __future__ import annotations

from annotator.formats.rcv.model import RcvManifest
from annotator.types.messages import amount

TEXT = """\
# 3D boxes of {objects} in {frames}

A dataset of camera images, coloured point clouds and fully oriented 3D boxes, modelled on 3D_HUMAN and 3D_HAND (Gui
and Luximon, "Recursive Cross-View", RA-L 2023).
Written by {generator}; format {format}, version {version}.

## Files

| path | content |
|---|---|
| `dataset.json` | classes, cameras, conventions, counts, detectors, and the ids of all frames in order |
| `images/ID.{image}` | the image of the colour camera, 8-bit RGB{image_note} |
| `clouds/ID.ply` | the points, binary little-endian PLY: float `x y z`{cloud_note} |
| `labels/ID.json` | the frame's origin (recording, key, index, time), its camera, and its objects |
| `splits/PART.txt` | only in a dataset divided into parts: the ids of each part, one per line |

`ID` is the recording's name and the frame's key within it.

## Frame of reference

Everything is in metres in the frame of the **colour camera**: right-handed, x right, y down, z forward (OpenCV).
Image and cloud are registered: with the label file's `camera`, a point falls on pixel

    u = fx * x' + cx,  v = fy * y' + cy,  where (x', y') = distort(x / z, y / z)

with OpenCV's distortion (`k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]`; an empty list is an ideal pinhole).
Pixels are continuous and the centre of the first pixel is (0, 0). `up` is the unit vector against gravity, or null
if unknown. `timestamp_ns` is the capture time in nanoseconds, or null. `world` is the camera's pose in
the map coordinates of the recording, or null without such: they are `rotation(quaternion) @ p + translation` for a
point p, `quaternion` being w x y z. Compute them with 64-bit floats.

## Objects

| field | meaning |
|---|---|
| `label` | the class: {classes} |
| `center` | the box's centre, x y z |
| `size` | full length, width, height along the box's own x, y, z axes |
| `rotation` | 3 x 3, row by row; its **columns** are the box's x, y, z axes in the camera frame |
| `quaternion` | the same rotation as w x y z |
| `corners` | the 8 corners as a 4 x 8 matrix of homogeneous columns, row by row: x, y, z, 1 |
| `score` | the detectors' confidence in 0..1, or null if no detector found the object |
| `source` | the origin of the box: `manual` (a person), `auto` (Recursive Cross-View), `imported` |
| `state` | the review: `proposed` (not reviewed), `accepted`, `edited` (changed by a person), `rejected` |
| `author`, `time_ns` | author and time (nanoseconds since 1970) of the last change |
| `uid` | unique in the project; unchanged by edits |
| `expected_iou_loss` | 1 - IoU with the true box, as the fit expects it; null if unknown or edited |
| `suggestion` | the view detector that suggested boxes to the operator, and whether they were corrected; or null |
| `box_kind` | what the box encloses: `box` (the whole object) or `silhouette` (only what is seen of it) |
| `attributes` | values of the box's attributes, by name |
| `said` | what each source, such as another detector, said of the object before the review |
| `track_id` | the same number for the same object over a recording, or null |

The corners' order, as signs along the box's own x, y, z:

    {corner_order}

Corner k is `center + rotation @ (signs_k * size / 2)`. A 4 x 4 transform moves a box by multiplying `corners` from
the left (Eq. (1) of the paper).

Example, in Python:

    import json, pathlib
    import numpy as np

    labels = json.loads(pathlib.Path("labels/{example}.json").read_text())
    for item in labels["objects"]:
        corners = np.array(item["corners"])[:3].T      # 8 x 3, metres
        print(item["label"], item["state"], corners.mean(axis=0))

## What is in it

{tables}
"""


CLOUD_NOTE = ", then, if the sensor measures them, uchar `red green blue` and float `reflectance` (0..1)"


def readme_text(manifest: RcvManifest) -> str:
    """Returns the README.md for a dataset with this manifest."""
    counts, options = manifest.counts, manifest.options
    jpeg = options.image_format == "jpg"
    tables = [
        _table("class", "objects", counts.objects_by_class),
        _table("review state", "objects", {str(state): n for state, n in counts.objects_by_state.items()}),
        _table("recording", "frames", counts.frames_by_recording),
        _table("recording", "objects", counts.objects_by_recording),
        _table("detector", "name and fingerprint", {d.role: f"{d.name} {d.fingerprint}" for d in manifest.detectors}),
    ]
    return TEXT.format(
        objects=amount(counts.objects, "object"),
        frames=amount(counts.frames, "frame"),
        generator=manifest.generator,
        format=manifest.format,
        version=manifest.version,
        image=options.image_format,
        image_note=f", JPEG quality {options.jpeg_quality}" if jpeg else ", lossless",
        cloud_note=CLOUD_NOTE,
        classes=", ".join(f"`{name}`" for name in manifest.classes),
        corner_order="  ".join(manifest.conventions.corner_order),
        example=manifest.frames[0],
        tables="\n".join(table for table in tables if table),
    )


def _table(first: str, second: str, rows: dict[str, int] | dict[str, str]) -> str:
    """Returns a Markdown table of two columns; "" without rows."""
    if not rows:
        return ""
    cells = [tuple(str(cell).replace("|", "\\|") for cell in row) for row in rows.items()]
    lines = [f"| {first} | {second} |", "|---|---|", *(f"| {key} | {value} |" for key, value in cells)]
    return "\n".join(lines) + "\n"
