"""What is damaged: a small recording or dataset for each reader, each kind of file, and each parser of labels.

This folder is the one place of tests of damage. `test_damaged_files.py` damages each target in the same ways (bytes
cut, changed and exchanged; fields removed and made wild) and demands a frame, labels, or an error that names the file,
in bounded time and memory. It fails when a reader of `annotator.recordings.open`, a format of 3D boxes or one of 2D
boxes has no target here, so a format needs no test of damage of its own: a new parser gets a row in `TARGETS`.
"""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import small_recordings as small
from bag_writer import MS, SIZE, START_NS, BagWriter, write_camera, write_take
from cloud_samples import SCAN
from dataset_samples import make_item, make_label, write
from foxglove_takes import picture_take, write_mcap
from kinect_recording import write_recording
from known_numbers import BUILT, CLASSES, CLOUDS, Numbers, bags
from known_numbers import TARGETS as KNOWN
from scipy.spatial.transform import RigidTransform
from test_cloud_files import written
from test_kitti_formats import PEDESTRIAN, VAN, document

from annotator.formats.kitti_folders import read_kitti_file
from annotator.formats.kitti_rows import read_rows, row_truth
from annotator.formats.kitti_tracklets import read_tracklets
from annotator.formats.nuscenes import read_results
from annotator.formats.reading import (
    Angles,
    read_mask,
    text_files,
)
from annotator.formats.sunrgbd import read_extracted_labels, read_scene_labels
from annotator.formats.table import FORMATS, BoxFormat
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.types import Frame
from annotator.workflows.importing.readers import read_labels
from annotator.workflows.recorded.reading import has_truth, load_truth

SHARED = Path(os.environ.get("ANNOTATOR_SHARED", Path(__file__).resolve().parents[3] / "shared"))


@dataclass(frozen=True)
class Target:
    """Something to damage: written below an existing folder, and read as a user's command does."""

    name: str
    build: Callable[[Path], object]
    read: Callable[[Path], Frame | None]


def read_frame(path: Path, options: ReaderOptions | None = None) -> Frame:
    """Reads the first frame, its labels and what the recording says of itself."""
    recording = open_recording(path, options or ReaderOptions())
    _ = recording.notes
    frame = recording.frame(0)
    assert np.isfinite(frame.cloud.xyz_m).all()
    assert len(frame.cloud) > 0
    assert frame.up is None or abs(np.linalg.norm(frame.up) - 1) < 1e-6
    assert frame.T_camera_label is None or np.isfinite(frame.T_camera_label.as_matrix()).all()
    if has_truth(recording):
        load_truth(recording, 0, frame)
    return frame


def read_around(path: Path) -> Frame:
    """Reads a virtual camera of a LiDAR."""
    return read_frame(path, ReaderOptions(look_around=4))


def cloud(name: str, content: Callable[[], bytes]) -> Target:
    """A folder with one cloud."""
    file = f"0.{name.partition('_')[0]}"
    return Target(
        name, lambda folder: (folder / file).write_bytes(content()), lambda folder: read_points(folder / file)
    )


def read_points(path: Path) -> None:
    """Reads a cloud without drawing it, which takes longer."""
    raw = read_cloud(path)
    assert np.isfinite(raw.xyz_m).all()
    assert len(raw.xyz_m) > 0


def bag(container: str, compression: str = "") -> Callable[[Path], object]:
    def build(folder: Path) -> None:
        with BagWriter(folder, container, compression) as writer:
            write_take(writer, 2)
        if writer.path.is_dir():
            shutil.copytree(writer.path, folder, dirs_exist_ok=True)
            shutil.rmtree(writer.path)

    return build


def foxglove(encoding: str) -> Callable[[Path], object]:
    def build(folder: Path) -> None:
        write_mcap(folder / "a.mcap", encoding, [(START_NS, picture_take(encoding))])

    return build


def depth_bag(form: str) -> Callable[[Path], object]:
    """A bag with a camera and compressed depth images."""

    def build(folder: Path) -> None:
        png = cv2.imencode(".png", np.full(SIZE[::-1], 1500, np.uint16))[1].tobytes()
        # the size, one run of 768 depths of which only the first differs from the one before, 767 differences of 0
        rvl = np.array([*SIZE, 0x088C18FE, 0x50000000, *[0] * 95], "<u4").tobytes()
        data = bytes(12) + (rvl if "rvl" in form else png)
        with BagWriter(folder, "ros1") as writer:
            for i in range(2):
                time_ns = START_NS + i * 100 * MS
                write_camera(writer, "cam", time_ns)
                writer.compressed("/cam/depth/compressedDepth", time_ns, form, data)

    return build


def kinect(fourcc: str) -> Target:
    still = [(time_us, (0.0, 0.0, -9.81)) for time_us in range(0, 100_000, 10_000)]
    return Target(
        f"azure_kinect_{fourcc.lower()}",
        lambda folder: write_recording(folder / "a.mkv", fourcc, 2, felt=still),
        lambda folder: read_frame(folder / "a.mkv"),
    )


def labelled(count: int = 2) -> list[Any]:
    return [make_item([make_label(track_id=1), make_label(uid="b")], key=f"{n:06d}", index=n) for n in range(count)]


def posed(name: str, file: str, content: str) -> Target:
    """A small recording with poses in a file."""

    def build(folder: Path) -> None:
        BUILT[name](folder)
        small.put(folder / file, content)

    def read(folder: Path) -> Frame:
        frame = read_frame(folder)
        assert frame.T_world_camera is None or np.isfinite(frame.T_world_camera.as_matrix()).all()
        return frame

    return Target(f"{name}_{file.rpartition('.')[0].replace('/', '_')}", build, read)


MATRIX = "1 0 0 2\n0 1 0 3\n0 0 1 4\n"
OXTS = "49.011 8.422 112.83 0.022 0.001 -1.22" + " 0.5" * 24 + "\n"
TRAJECTORY = json.dumps({"parameters": [{"extrinsic": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 2, 3, 4, 1]}]})


def odometry_bag(folder: Path) -> None:
    """A bag that has poses in a topic."""
    with BagWriter(folder, "ros1") as writer:
        write_take(writer, 2)
        for i in range(3):
            time_ns = START_NS + i * 50 * MS
            pose = {"pose": {"position": {"x": 0.1 * i}, "orientation": {"w": 1.0}}}
            head = writer.header(time_ns, "map")
            writer.write("/odom", time_ns, "nav_msgs/Odometry", header=head, child_frame_id="camera", pose=pose)


def exported(name: str, items: list[Any] | None = None, **options: Any) -> Callable[[Path], object]:
    """Builds an export in the format of that name."""

    def build(folder: Path) -> None:
        folder.rmdir()
        write(name, folder, items or labelled(), classes=CLASSES, **options)

    return build


def read_export(name: str, folder: Path) -> None:
    read_labels(BoxFormat(name), folder)


def read_kitti(file: Path, tracking: bool = False) -> None:
    for row in read_rows(file, tracking=tracking):
        if row.is_solid:
            row_truth(row, SHIFT, file, Angles())


def label_file(name: str, file: str, content: str | bytes, read: Callable[[Path], object]) -> Target:
    data = content.encode() if isinstance(content, str) else content
    return Target(f"labels_{name}", lambda f: (f / file).write_bytes(data), lambda f: read(f / file) and None)


def zipped(text: str) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("a.txt", "b/c.txt"):
            archive.writestr(name, text)
    return out.getvalue()


CAR = "Car 0.25 2 -1.55 548.00 171.33 572.40 194.42 1.48 1.56 3.62 -2.72 0.82 48.22 -1.62"
POLYGON = {"X": [0, 1, 1, 0], "Z": [1, 1, 3, 3], "Ymin": 0.5, "Ymax": 1.5}
SCENE = json.dumps({"objects": [{"name": "bed", "polygon": [POLYGON]}]}, indent=1)
SHIFT = RigidTransform.from_translation([0.1, 0.2, 0.3])
RESULTS = {
    "meta": {"use_lidar": True},
    "results": {
        "3e8750f331d7499e9b5123e9eb70f2e2": [
            {"translation": [1.5, -2.0, 0.8], "size": [1.9, 4.5, 1.6], "rotation": [0.6, 0.0, 0.0, 0.8],
             "velocity": [0.1, 0.0], "detection_name": "car", "detection_score": 0.75,
             "attribute_name": "vehicle.moving"},
            {"translation": [7, 3, 1], "size": [0.6, 0.7, 1.8], "rotation": [1, 0, 0, 0], "velocity": [0, 0],
             "tracking_name": "pedestrian", "tracking_score": 0.5, "tracking_id": "17"},
        ],
        "empty": [],
    },
}  # fmt: skip
NUMBERS = Numbers.drawn(random.Random(0))


def of_numbers(name: str) -> Target:
    """The same that is written with known numbers, too."""
    known = next(each for each in KNOWN if each.name == name)
    return Target(name, lambda folder: known.write(folder, NUMBERS), lambda folder: known.read(folder) and None)


TARGETS: list[Target] = [
    *(Target(name, build, read_frame) for name, build in BUILT.items() if name not in ("record3d", "sunrgbd_scene")),
    Target("sunrgbd_scene", lambda folder: small.sunrgbd_scene(folder / "scene"), lambda f: read_frame(f / "scene")),
    Target("record3d", lambda folder: small.made.write_record3d(folder / "a.r3d", small.made.frames(2)),
           lambda folder: read_frame(folder / "a.r3d")),
    Target("record3d_unpacked", BUILT["record3d"], read_frame),
    posed("rgbd_folder", "poses.csv", "key,x,y,z,qw,qx,qy,qz\n0,1,2,3,0.5,0.5,0.5,0.5\n"),
    posed("rgbd_folder", "trajectory.log", f"0 0 1\n{MATRIX}0 0 0 1\n"),
    posed("rgbd_folder", "camera_trajectory.json", TRAJECTORY),
    posed("kitti_tracking", "poses.txt", MATRIX.replace("\n", " ") + "\n"),
    posed("kitti_tracking", "oxts.txt", OXTS),
    posed("kitti_raw", "oxts/data/0.txt", OXTS),
    Target("ros1_odometry", odometry_bag, lambda f: read_frame(bags(f))),
    Target("nuscenes_around", BUILT["nuscenes"], read_around),
    Target("argoverse2_around", BUILT["argoverse2"], read_around),
    Target("kitti_around", BUILT["kitti_tracking"], read_around),
    *(cloud(name, partial(content, NUMBERS)) for name, content in CLOUDS.items() if name != "bin"),
    cloud("bin", SCAN.tobytes),
    cloud("laz_layered", lambda: written("1.4", 7, 2, True)),
    *(Target(f"ros1_{how or 'plain'}", bag("ros1", how), lambda f: read_frame(bags(f))) for how in ("", "bz2", "lz4")),
    *(Target(f"sqlite3_{how or 'plain'}", bag("sqlite3", how), read_frame) for how in ("", "message")),
    *(Target(f"mcap_{how or 'plain'}", bag("mcap", how), read_frame) for how in ("", "storage", "message")),
    *(Target(f"foxglove_{how}", foxglove(how), lambda f: read_frame(bags(f))) for how in ("protobuf", "json")),
    *(Target(f"compressed_depth_{how}", depth_bag(f"16UC1; compressedDepth {how}"), lambda f: read_frame(bags(f)))
      for how in ("png", "rvl")),
    *(kinect(fourcc) for fourcc in ("NV12", "MJPG")),
    *(Target(f"export_{name.replace('-', '_')}", exported(name), partial(read_export, name))
      for name, format in FORMATS.items() if format.writer),
    Target("labelcloud_vertices", exported("labelcloud", vertices=True), partial(read_export, "labelcloud")),
    Target("nuscenes_results", lambda folder: (folder / "results.json").write_text(json.dumps(RESULTS)),
           lambda folder: list(read_results(folder / "results.json")) and None),
    *map(of_numbers, ("export_boxes", "export_box_csv", "coco", "yolo")),
    label_file("kitti", "0.txt", f"{CAR}\n{CAR}\n", read_kitti),
    label_file("kitti_tracking", "l.txt", f"0 1 {CAR}\n1 1 {CAR}\n", partial(read_kitti, tracking=True)),
    label_file("kitti_results", "0.txt", f"{CAR} 0.5\n", lambda file: read_kitti_file(file, scored=True)),
    label_file("sunrgbd", "0.txt", "bed 1 2 30 40 0.1 0.2 0.3 0.5 1 0.4 0.6 0.8\n",
               lambda file: read_extracted_labels(file, SHIFT)),
    label_file("sunrgbd_scene", "index.json", SCENE, lambda file: read_scene_labels(file, SHIFT)),
    label_file("archive", "labels.zip", zipped(CAR), lambda file: list(text_files(file))),
    label_file("mask", "0.png", cv2.imencode(".png", np.ones((3, 4), np.uint8))[1].tobytes(),
               lambda file: read_mask(file).any()),
    Target("tracklets",
           lambda folder: (folder / "tracklet_labels.xml").write_text(document(VAN, PEDESTRIAN)),
           lambda folder: read_tracklets(folder / "tracklet_labels.xml") and None),
    Target("export_argoverse2", BUILT["argoverse2"],
           lambda folder: read_labels(BoxFormat.ARGOVERSE2, folder) and None),
]  # fmt: skip
if (SHARED / "data" / "realsense").is_dir():
    REAL = next((SHARED / "data" / "realsense").glob("*.bag"))
    TARGETS.append(
        Target("realsense", lambda f: (f / "a.bag").write_bytes(REAL.read_bytes()), lambda f: read_frame(f / "a.bag"))
    )
