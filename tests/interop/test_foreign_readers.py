"""Other tools read our exports as they were written.
One project is exported in each format. Corners must agree, in any order. The readers in `readers/` run as separate
programs in `.venv-interop` (`scripts/setup interop`).
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import box_corners, nearest_upright
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project as to_image
from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, Source
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.exporting import ExportFormat, ExportOptions, Split, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import load_truth

HERE = Path(__file__).resolve().parent
PYTHON = HERE.parent.parent / ".venv-interop/bin/python"
CORNER_M, PIXEL = 1e-3, 0.5
LABELLED = (0, 1, 3)
SPLIT = Split({"train": 0.6, "val": 0.4})
DRAWN = (Box2D("person", 10.25, 20.5, 60.75, 90.0), Box2D("person", 100.0, -0.5, 160.5, 239.5))
Read = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> Read:
    """`read("read_coco", ARGUMENT, ...)`: the JSON output of a reader."""
    if not (PYTHON.parent.parent / "setup.done").is_file():
        if os.environ.get("ANNOTATOR_INTEROP") == "required":
            pytest.fail("scripts/setup interop has not finished, but ANNOTATOR_INTEROP=required")
        pytest.skip("no .venv-interop; run scripts/setup interop")

    # some readers write logs to the working folder
    cwd = tmp_path_factory.mktemp("readers")

    def run(name: str, *arguments: str | Path) -> dict[str, Any]:
        command = [str(PYTHON), str(HERE / f"readers/{name}.py"), *map(str, arguments)]
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads(done.stdout)

    return run


@pytest.fixture(scope="module")
def project(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """People in three frames with their true boxes as tracks; the first box of each frame is tilted by 10 degrees."""
    made = create_project(tmp_path_factory.mktemp("interop"), "interop", ("person", "dog"))
    register_recording(made, open_recording(generated / "people"))
    recording = open_recording(generated / "people")
    for index in LABELLED:
        truths = load_truth(recording, index, recording.frame(index))
        tilt = Rotation.from_euler("XY", [10, -4], degrees=True).as_matrix()
        boxes = [t.box for t in truths]
        boxes[0] = OrientedBox.from_parts(boxes[0].center_m, boxes[0].rotation @ tilt, boxes[0].size_m)
        new = [NewLabel("person", box, track_id=number) for number, box in enumerate(boxes)]
        made.labels.create(made.frames.of()[index].id, new, WriteContext(0, "me", Source.MANUAL))
    yield made
    made.close()


@pytest.fixture(scope="module")
def frames(project: Project) -> dict[str, tuple[Frame, list[OrientedBox]]]:
    """The labelled frames and their boxes (camera frame), by file name."""
    source, stored = FrameSource(project), project.frames.of()
    return {
        f"people-{stored[index].key}": (
            source.read(stored[index]),
            [label.box for label in project.labels.of_frame(stored[index].id)],
        )
        for index in LABELLED
    }


def assert_same_corners(seen: Sequence[Any], boxes: Sequence[OrientedBox], within_m: float = CORNER_M) -> None:
    """Asserts that the eight corners of each box agree, in any order."""
    assert len(seen) == len(boxes)
    for corners, box in zip(seen, boxes, strict=True):
        distances, nearest = cKDTree(box_corners(box)).query(np.array(corners))
        assert sorted(nearest.tolist()) == list(range(8))
        assert distances.max() < within_m


def export(project: Project, out: Path, format: ExportFormat, **options: Any) -> Path:
    export_project(project, out, format, **options)
    return out


def test_nuscenes_devkit_reads_boxes_clouds_and_tracks(
    read: Read, project: Project, frames: dict[str, Any], tmp_path: Path
) -> None:
    out = export(project, tmp_path / "out", ExportFormat.NUSCENES)
    seen = read("read_nuscenes", out, "v1.0-annotator")
    assert set(seen["frames"]) == set(frames)
    for name, (frame, boxes) in frames.items():
        there = seen["frames"][name]
        assert {box["label"] for box in there["boxes"]} == {"person"} and there["scene"] == "people"
        assert_same_corners([box["corners"] for box in there["boxes"]], boxes)
        ours_px = to_image(frame.camera, np.array([box.center_m for box in boxes]))
        np.testing.assert_allclose([box["centre_px"] for box in there["boxes"]], ours_px, atol=PIXEL)
        assert there["points"] == len(frame.cloud)
        assert set(there["instances"]) == set(seen["tracks"])


def test_labelcloud_reads_boxes_and_clouds(
    read: Read, project: Project, frames: dict[str, Any], tmp_path: Path
) -> None:
    forms = {"centroid_rel": False, "vertices": True}
    outs = [
        export(project, tmp_path / form, ExportFormat.LABELCLOUD, options=ExportOptions(vertices=vertices))
        for form, vertices in forms.items()
    ]
    folders = read("read_labelcloud", *outs)["folders"]
    assert [(seen["classes"], seen["format"]) for seen in folders] == [(["person", "dog"], form) for form in forms]
    for out, seen in zip(outs, folders, strict=True):
        for name, (frame, boxes) in frames.items():
            there = seen["frames"][name]
            assert (there["points"], there["colored"]) == (len(frame.cloud), frame.cloud.rgb is not None)
            # the calibration, in KITTI's format, maps the cloud's frame to the camera
            rows = [line.split() for line in (out / f"calib/{name}.txt").read_text().splitlines()]
            (T,) = (np.array(row[1:], np.float64).reshape(3, 4) for row in rows if row[0] == "Tr_velo_to_cam:")
            assert_same_corners([np.array(box["corners"]) @ T[:, :3].T + T[:, 3] for box in there["boxes"]], boxes)
            first_m = T[:, :3] @ there["first_m"] + T[:, 3]
            np.testing.assert_allclose(first_m, frame.cloud.xyz_m[0], atol=CORNER_M)


def test_openlabel_readers_find_the_boxes_and_no_errors(
    read: Read, project: Project, frames: dict[str, Any], tmp_path: Path
) -> None:
    out = export(project, tmp_path / "out", ExportFormat.OPENLABEL)
    (file,) = out.glob("*.json")
    seen = read("read_openlabel", file)
    assert [issue for issue in seen["issues"] if issue["severity"] == "error"] == []
    assert len(seen["frames"]) == len(frames)
    for there, (_, boxes) in zip(seen["frames"].values(), frames.values(), strict=True):
        assert {(box["label"], box["frame"]) for box in there["boxes"]} == {("person", "camera")}
        assert_same_corners([box["corners"] for box in there["boxes"]], boxes)
    assert "camera" in seen["systems"]


@pytest.fixture(scope="module")
def of_torch(read: Read, project: Project, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What Ultralytics and torchvision read of a divided YOLO dataset and of a KITTI folder."""
    out = tmp_path_factory.mktemp("torch")
    export(project, out / "Kitti/raw", ExportFormat.KITTI)
    draw(project)
    yolo = export(project, out / "yolo", ExportFormat.YOLO, split=SPLIT)
    return read("read_yolo_and_kitti", yolo / "data.yaml", out)


def test_torchvision_reads_kitti_boxes(of_torch: dict[str, Any], frames: dict[str, Any]) -> None:
    """KITTI's rows are upright with two decimals; corners are computed by KITTI's definition."""
    seen = of_torch
    assert set(seen["frames"]) == {frame.key for frame, _ in frames.values()}
    for frame, boxes in frames.values():
        there = seen["frames"][frame.key]
        assert there["size"] == [frame.camera.width_px, frame.camera.height_px]
        # boxes outside the image have no row
        shown = [box for box in boxes if box_on_image(frame.camera, box, "person") is not None]
        assert [found["type"] for found in there["objects"]] == ["person"] * len(shown)
        for found, box in zip(there["objects"], shown, strict=True):
            upright, _ = nearest_upright(box, np.array([0.0, -1.0, 0.0]))
            h, w, length = found["dimensions"]
            c, s = np.cos(found["rotation_y"]), np.sin(found["rotation_y"])
            R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
            signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-1, 0) for z in (-0.5, 0.5)])
            corners = (signs * [length, h, w]) @ R.T + found["location"]
            assert_same_corners([corners], [upright], within_m=0.03)
            # the 2D box is that of the rounded 3D box, clipped to 0 .. width - 1 as in KITTI
            px = to_image(frame.camera, corners).clip(0, np.array(there["size"]) - 1)
            np.testing.assert_allclose(found["bbox"], [*px.min(axis=0), *px.max(axis=0)], atol=PIXEL)


def draw(project: Project) -> None:
    """Sets boxes on the image of an unlabelled frame, and none on another."""
    ids = [frame.id for frame in project.frames.of()]
    for index, boxes in ((2, DRAWN), (4, ())):
        revision = project.frames.get(ids[index]).revision
        project.boxes.set_on_image(ids[index], boxes, BoxKind.SILHOUETTE, WriteContext(revision, "me"))


def outlines(frames: dict[str, Any]) -> dict[str, list[Box2D]]:
    """The expected 2D boxes: outlines of the 3D boxes, and the boxes of `draw`."""
    found = {
        name: [box for each in boxes if (box := box_on_image(frame.camera, each, "person")) is not None]
        for name, (frame, boxes) in frames.items()
    }
    return {**found, "people-000002": list(DRAWN), "people-000004": []}


def test_pycocotools_and_ultralytics_read_the_2d_boxes(
    read: Read, of_torch: dict[str, Any], project: Project, frames: dict[str, Any], tmp_path: Path
) -> None:
    coco = export(project, tmp_path / "coco", ExportFormat.COCO, split=SPLIT)
    by_yolo = of_torch["pictures"]
    assert len(by_yolo) == 5
    for part in ("train", "val"):
        by_coco = read("read_coco", coco / f"annotations/instances_{part}.json")["pictures"]
        assert {f"{part}/{name}" for name in by_coco} == {name for name in by_yolo if name.startswith(part)}
        for name, there in by_coco.items():
            width, height = there["size"]
            ours = outlines(frames)[name.removesuffix(".png")]
            assert by_yolo[f"{part}/{name}"]["size"] == [width, height] == [320, 240]
            # both measure from the image's corner, half a pixel before the first pixel's centre
            corners = np.array([box.xyxy for box in ours]).reshape(-1, 4) + 0.5
            x, y, w, h, area = np.array([row[1:] for row in there["boxes"]]).reshape(-1, 5).T
            np.testing.assert_allclose(np.column_stack([x, y, x + w, y + h]), corners, atol=1e-6)
            np.testing.assert_allclose(area, w * h)
            rows = np.array([row[1:] for row in by_yolo[f"{part}/{name}"]["boxes"]]).reshape(-1, 4)
            cx, cy, w, h = rows.T * np.array([[width], [height]] * 2)
            seen = np.column_stack([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2])
            np.testing.assert_allclose(seen, corners, atol=1e-3)


def test_open3d_reads_the_clouds(read: Read, project: Project, frames: dict[str, Any], tmp_path: Path) -> None:
    out = export(project, tmp_path / "out", ExportFormat.RCV)
    files = {name: str(out / f"clouds/{name}.ply") for name in frames}
    seen = read("read_clouds", *files.values())
    for name, (frame, _) in frames.items():
        there = seen["clouds"][files[name]]
        assert there["points"] == len(frame.cloud)
        np.testing.assert_allclose(there["low"], frame.cloud.xyz_m.min(axis=0), atol=1e-5)
        np.testing.assert_allclose(there["high"], frame.cloud.xyz_m.max(axis=0), atol=1e-5)
        assert frame.cloud.rgb is not None
        np.testing.assert_allclose(there["colour"], frame.cloud.rgb.mean(axis=0), atol=1e-3)
