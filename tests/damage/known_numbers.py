"""Known numbers, and small recordings and label files that are written from them, for each reader.

`Numbers` has what is written, and in which way. What the program reads of it is a `Reading`. Points and boxes are
compared in the frame of the first box, so the place of a virtual camera does not matter.
"""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cloud_samples
import cv2
import laspy
import numpy as np
import phone_samples
import small_recordings as small
from bag_writer import MS, SIZE, START_NS, BagWriter, K, structured
from dataset_samples import make_item, make_label, write
from scipy.spatial.transform import Rotation
from small_recordings import put

from annotator.formats.box_files import write_boxes
from annotator.formats.table import BoxFormat, FlatFormat
from annotator.geometry.oriented_box import box_corners
from annotator.recordings import open_recording
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.types import Frame, Label, OrientedBox, Truth
from annotator.types.errors import FormatError
from annotator.workflows.importing.pictures import read_pictures
from annotator.workflows.importing.readers import read_labels
from annotator.workflows.recorded.reading import has_truth, load_truth

Reading = dict[str, np.ndarray]
WIDTH, HEIGHT = SIZE
CAMERA = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K.T.ravel().tolist()}
# of a LiDAR's x forward, y left, z up in a camera's axes
AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
# points in the first box, and elsewhere
INSIDE, OUTSIDE = 60, 91


@dataclass(frozen=True, eq=False)
class Numbers:
    """What is written, and how.

    Attributes:
        xyz_m, rgb, share: points in a LiDAR's frame, their colours and reflectances (0..1).
        centers_m, sizes_m, yaws: two upright boxes in the same frame.
        depth_mm, image: of a camera, without relation to the points; depth 0 = no measurement.
        pixels: boxes on the image: left, top, right, bottom.
        origin_m: added to points and boxes.
        odd_m: rows that are no points.
        colours, shares: how colours and reflectances are written.
        hole: what is written where there is no depth.
    """

    xyz_m: np.ndarray
    rgb: np.ndarray
    share: np.ndarray
    centers_m: np.ndarray
    sizes_m: np.ndarray
    yaws: np.ndarray
    depth_mm: np.ndarray
    image: np.ndarray
    pixels: np.ndarray
    origin_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    odd_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colours: str = "bytes"
    shares: str = "floats"
    hole: float = 0.0

    @classmethod
    def drawn(cls, draw: random.Random) -> Numbers:
        """Other numbers for each seed."""
        rng = np.random.default_rng(draw.randrange(2**32))
        centers = np.array([[12.0, 1.0, 0.5], [16.0, -3.0, 0.2]]) + rng.uniform(-0.9, 0.9, (2, 3))
        sizes = rng.uniform((3, 1.5, 0.8), (5, 2.2, 1.9), (2, 3))
        yaws = rng.choice((-1, 1), 2) * rng.uniform(0.05, 1.2, 2)
        inside = rng.uniform(-0.45, 0.45, (INSIDE, 3)) * sizes[0] @ upright(yaws[:1])[0].T + centers[0]
        xyz = np.r_[inside, rng.uniform((-18, -18, -2), (18, 18, -1.5), (OUTSIDE, 3))]
        depth = rng.integers(800, 6000, (HEIGHT, WIDTH)) * (rng.random((HEIGHT, WIDTH)) < 0.8)
        image = cv2.resize(rng.integers(0, 256, (4, 5, 3)).astype(np.uint8), SIZE)
        # two boxes of an image must differ
        corner = np.c_[rng.permutation(np.arange(1, 8))[:2], rng.integers(1, 8, 2)]
        return cls(
            # to 1/128 m, which every format holds exactly
            np.round(xyz * 128) / 128, rng.integers(0, 256, xyz.shape, np.uint8), rng.integers(0, 256, len(xyz)) / 255,
            centers, sizes, yaws, depth, image, np.c_[corner, corner + rng.integers(5, 14, (2, 2))].astype(float),
        )  # fmt: skip

    def known(self) -> Reading:
        """What must come out, however it is written; the points and colours are those in the first box."""
        points = (self.xyz_m[:INSIDE] - self.centers_m[0]) @ upright(self.yaws)[0]
        return {
            "corners": of_boxes(self.boxes())["corners"], "points": points, "colours": self.rgb[:INSIDE],
            "reflectances": self.share, "image": self.image, "depth": self.depth_mm / 1000, "pixels": self.pixels,
        }  # fmt: skip

    def rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The rows of a cloud's file: places, colours and reflectances, as they are written."""
        at = np.linspace(0, len(self.xyz_m), len(self.odd_m) + 2).astype(int)[1:-1]
        xyz = np.insert(self.xyz_m + self.origin_m, at, self.odd_m, axis=0)
        rgb, share = np.insert(self.rgb, at, 0, axis=0), np.insert(self.share, at, 0.0)
        colours = {"bytes": rgb, "words": rgb.astype(np.uint16) * 257, "floats": rgb / 255, "float_bytes": rgb * 1.0}
        shares = {"bytes": np.rint(share * 255).astype(np.uint8), "words": (share * 65535).astype(np.uint16)}
        return xyz, colours[self.colours], shares.get(self.shares, share)

    def boxes(self) -> list[OrientedBox]:
        """In the frame of the points, as it is written."""
        return list(map(OrientedBox.from_parts, self.centers_m + self.origin_m, upright(self.yaws), self.sizes_m))

    def items(self) -> list[Any]:
        """A frame with the boxes, for the writers of datasets."""
        boxes = [OrientedBox.from_parts(AXES @ box.center_m, AXES @ box.rotation, box.size_m) for box in self.boxes()]
        labels = [make_label(box, uid=f"u{number}", track_id=number) for number, box in enumerate(boxes)]
        return [make_item(labels, key="000000", index=0)]

    def picture(self) -> np.ndarray:
        """The image."""
        return self.image.astype(np.uint16) * 257 if self.colours == "words" else self.image

    def depths(self, kind: type, unit_m: float) -> np.ndarray:
        """The depth image in some unit."""
        return np.where(self.depth_mm == 0, self.hole, np.round(self.depth_mm * (0.001 / unit_m), 6)).astype(kind)


def upright(yaws: np.ndarray) -> np.ndarray:
    """Rotations about z, (n, 3, 3)."""
    return np.asarray(Rotation.from_euler("z", yaws[:, None]).as_matrix())


def of_boxes(boxes: Sequence[OrientedBox]) -> Reading:
    """Boxes in the frame of the first one; and the distances between all corners, whatever the axes are called."""
    corners, first = np.concatenate([box_corners(each) for each in boxes]), boxes[0]
    turn = first.rotation
    there = [[(box.center_m - first.center_m) @ turn, *(turn.T @ box.rotation), box.size_m] for box in boxes]
    return {"boxes": np.array(there), "corners": np.sort(np.linalg.norm(corners[:, None] - corners, axis=2).ravel())}


def of_frame(frame: Frame, found: Sequence[Truth], is_virtual: bool) -> Reading:
    """All numbers of a frame that do not depend on where a virtual camera stands."""
    reading, xyz = Reading(), frame.cloud.xyz_m.astype(np.float64)
    # a virtual camera sees only what is in front of it
    seen = np.ones(len(xyz), bool)
    if found:
        box = found[0].box
        xyz = (xyz - box.center_m) @ box.rotation
        seen = (np.abs(xyz) <= box.size_m / 2 + 0.01).all(axis=1) | (not is_virtual)
        reading |= of_boxes([each.box for each in found])
    reading |= {"points": xyz[seen]} | ({} if frame.cloud.rgb is None else {"colours": frame.cloud.rgb[seen]})
    if not is_virtual:
        time_s = None if frame.timestamp_ns is None else np.array([frame.timestamp_ns / 1e9])
        more = {
            "image": frame.rgb,
            "camera": frame.camera.matrix,
            "depth": frame.depth_m,
            "up": frame.up,
            "time": time_s,
        }
        reading |= {name: each for name, each in more.items() if each is not None}
    return reading


def read_recording(path: Path) -> Reading:
    """The first frame, with the labels that lie beside it."""
    recording = open_recording(path)
    frame = recording.frame(0)
    return of_frame(frame, load_truth(recording, 0, frame) if has_truth(recording) else [], False)


def read_scan(suffix: str, folder: Path) -> Reading:
    """A cloud with labels in its own frame."""
    frame = open_recording(folder / "scans").frame(0)
    labels, raw = read_labels(BoxFormat.SUSTECHPOINTS, folder / "labels"), read_cloud(scan_file(folder, suffix))
    reading = of_frame(frame, labels.truths(labels.frames[0], frame), True)
    if raw.rgb is None:  # drawn from other numbers
        reading.pop("colours", None)
    return reading if raw.reflectance is None else reading | {"reflectances": np.asarray(raw.reflectance)}


def read_boxes(format: BoxFormat, folder: Path) -> Reading:
    """A dataset of boxes."""
    (path,) = folder.iterdir()
    labels, (item,) = read_labels(format, path), Numbers.drawn(random.Random(0)).items()
    return of_boxes([each.box for each in labels.truths(labels.frames[0], item.frame)])


def read_flat(format: FlatFormat, folder: Path) -> Reading:
    """A dataset of 2D boxes."""
    pictures = read_pictures(format, folder).pictures
    if any(each.file(folder) is None for each in pictures):
        raise FormatError(folder, "an import says that an image is missing")
    return {"pixels": np.array([box.xyxy for each in pictures for box in each.boxes_on(*SIZE)])}


def png(pixels: np.ndarray) -> bytes:
    """A PNG file of an image in RGB order, or of one channel."""
    return cv2.imencode(".png", pixels[..., ::-1] if pixels.ndim == 3 else pixels)[1].tobytes()


def ply(form: str, n: Numbers) -> bytes:
    xyz, rgb, share = n.rows()
    columns = dict(zip(("x", "y", "z", "red", "green", "blue"), (*xyz.T, *rgb.T), strict=True)) | {"intensity": share}
    return cloud_samples.ply(structured(columns), form)


def pcd(form: str, n: Numbers) -> bytes:
    """Colours are the bits of a whole number or of a float; `words`: in a text, whole numbers in a column of floats."""
    xyz, _, share = n.rows()
    packed = replace(n, colours="bytes").rows()[1].astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    bits = packed if n.colours == "bytes" else packed.view(np.float32)
    rows = structured(columns := dict(zip("xyz", xyz.T, strict=True)) | {"rgb": bits, "intensity": share})
    whole = structured(columns | {"rgb": packed}) if n.colours == "words" else rows
    return cloud_samples.pcd(rows, form, cloud_samples.as_text(whole) if form == "ascii" else None)


def las(is_compressed: bool, n: Numbers) -> bytes:
    """`words` is the standard's way of colours; many programs write bytes."""
    xyz, rgb, share = n.rows()
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    cloud.header.scales, cloud.header.offsets = np.full(3, 1 / 128), np.zeros(3)
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.intensity = (share * 65535).astype(np.uint16)
    cloud.red, cloud.green, cloud.blue = rgb.astype(np.uint16).T
    out = io.BytesIO()
    cloud.write(out, do_compress=is_compressed, laz_backend=laspy.LazBackend.Lazrs if is_compressed else None)
    return out.getvalue()


def scan_file(folder: Path, suffix: str) -> Path:
    return folder / "scans" / "velodyne" / f"0{suffix}"


def write_scan(suffix: str, content: Callable[[Numbers], bytes], folder: Path, n: Numbers) -> None:
    """A cloud, and SUSTechPOINTS' labels in its own frame."""
    put(scan_file(folder, suffix), content(n))
    objects = []
    for number, (box, yaw) in enumerate(zip(n.boxes(), n.yaws.tolist(), strict=True)):
        parts = {"position": box.center_m.tolist(), "scale": box.size_m.tolist(), "rotation": [0.0, 0.0, yaw]}
        psr = {name: dict(zip("xyz", part, strict=True)) for name, part in parts.items()}
        objects.append({"obj_id": str(number), "obj_type": "Car", "psr": psr})
    put(folder / "labels" / "label" / "0.json", json.dumps(objects))


def write_rgbd(folder: Path, n: Numbers) -> None:
    put(folder / "color" / "0.png", png(n.picture()))
    put(folder / "depth" / "0.png", png(n.depths(np.uint16, 0.001)))
    put(folder / "camera_intrinsic.json", json.dumps(CAMERA | {"depth_scale": 1000.0}))
    put(folder / "gravity.json", '{"up": [0.1, -1, 0.2]}')
    put(folder / "timestamps.csv", f"key,timestamp_ns\n0,{START_NS}\n")


def write_tum(folder: Path, n: Numbers) -> None:
    for name, pixels in (("rgb", n.picture()), ("depth", n.depths(np.uint16, 0.0002))):
        put(folder / name / "1.5.png", png(pixels))
        put(folder / f"{name}.txt", f"# comment\n1305031102.25 {name}/1.5.png\n")
    put(folder / "camera_intrinsic.json", json.dumps(CAMERA))


def write_phone(write: Callable[..., object], folder: Path, n: Numbers) -> None:
    large, sure = cv2.resize(n.image, (4 * WIDTH, 4 * HEIGHT)), np.full((HEIGHT, WIDTH), 2, np.uint8)
    image = (large, n.depths(np.float32, 1.0), sure)
    write(folder / "take", [image] * 2, phone_samples.K / [[4], [4], [1]])


def write_bag(encoding: str, folder: Path, n: Numbers) -> None:
    """A camera with depth in some encoding."""
    depth = n.depths(np.uint16, 0.001) if encoding == "16UC1" else n.depths(np.float32, 1.0)
    with BagWriter(folder, "ros1") as bag:
        for time_ns in (START_NS, START_NS + 100 * MS):
            bag.info("/cam/camera_info", time_ns, SIZE, K)
            bag.image("/cam/image_raw", time_ns, n.picture(), "rgb8")
            bag.image("/cam/depth/image_raw", time_ns, depth, encoding)


def write_csv(folder: Path, n: Numbers) -> None:
    """In upright depth: x right, y ahead, z up."""
    rows = np.c_[-n.centers_m[:, 1], n.centers_m[:, 0], n.centers_m[:, 2], n.sizes_m, n.yaws + np.pi / 2].tolist()
    lines = ["image,class,cx,cy,cz,l,w,h,yaw,score", *(f"0,hand,{','.join(map(repr, row))},0.5" for row in rows)]
    put(folder / "out.csv", "\n".join(lines) + "\n")


def truths(labels: Sequence[Label]) -> list[Truth]:
    return [Truth(each.label, each.box, each.track_id) for each in labels]


def write_json(folder: Path, n: Numbers) -> None:
    write_boxes(folder / "out", {"0": truths(n.items()[0].labels)})


def write_coco(folder: Path, n: Numbers) -> None:
    """Pixels are counted from the image's corner, not from the middle of the first one."""
    first, last = n.pixels[:, :2] + 0.5, n.pixels[:, 2:] + 0.5
    image = {"id": 1, "file_name": "left/a.png", "width": WIDTH, "height": HEIGHT}
    boxes = np.c_[first, last - first].tolist()
    rows = [{"id": number, "image_id": 1, "category_id": 1, "bbox": box} for number, box in enumerate(boxes)]
    document = {"images": [image], "annotations": rows, "categories": [{"id": 1, "name": "hand"}]}
    put(folder / "all" / "left" / "a.png", png(n.picture()))
    put(folder / "annotations" / "instances_all.json", json.dumps(document))


def write_yolo(folder: Path, n: Numbers) -> None:
    first, last = n.pixels[:, :2] + 0.5, n.pixels[:, 2:] + 0.5
    rows = (np.c_[(first + last) / 2, last - first] / np.tile(SIZE, 2)).tolist()
    put(folder / "images" / "a.png", png(n.picture()))
    put(folder / "labels" / "a.txt", "".join(f"0 {' '.join(map(repr, row))}\n" for row in rows))
    put(folder / "train.txt", "images/a.png\n")
    put(folder / "data.yaml", "train: train.txt\nval: train.txt\nnames:\n  0: hand\n")


@dataclass(frozen=True)
class Target:
    """One reader.

    Attributes:
        name: unique.
        write: writes numbers into an empty folder.
        read: what the program makes of it.
        known: which of `Numbers.known` it has; without any, the numbers are those of a sample of other tests.
        ways: mutations of the numbers that the format can express (`values.WAYS`).
        edits: mutations of what is written (`values.EDITS`).
    """

    name: str
    write: Callable[[Path, Numbers], None]
    read: Callable[[Path], Reading]
    known: tuple[str, ...] = ()
    ways: tuple[str, ...] = ()
    edits: tuple[str, ...] = ()


def cloud(name: str, *ways: str) -> Target:
    suffix, lacks = f".{name.partition('_')[0]}", {"bin": "colours", "npy": "reflectances", "npz": "reflectances"}
    known = tuple(each for each in ("corners", "points", "colours", "reflectances") if each != lacks.get(name))
    return Target(
        f"cloud_{name}",
        partial(write_scan, suffix, CLOUDS[name]),
        partial(read_scan, suffix),
        known,
        ways,
        ("degrees",),
    )


def dataset(name: str, *edits: str) -> Target:
    def build(folder: Path, n: Numbers) -> None:
        write(name, folder / "out", n.items(), classes=CLASSES)

    return Target(f"export_{name}", build, partial(read_boxes, BoxFormat(name)), ("corners",), (), edits)


def sample(name: str, *edits: str) -> Target:
    return Target(name, lambda folder, _: BUILT[name](folder), read_recording, edits=edits)


def npy(n: Numbers) -> bytes:
    return cloud_samples.npy(np.c_[n.rows()[:2]])


def read_phone(folder: Path) -> Reading:
    return read_recording(folder / "take")


def bags(folder: Path) -> Path:
    """The bag in a folder: a file, or the folder itself."""
    return next((file for file in folder.iterdir() if file.suffix in (".bag", ".mcap")), folder)


def read_bag(folder: Path) -> Reading:
    return read_recording(bags(folder))


FLOATS, COLOURS, MAP = ("nan", "inf"), ("words", "floats", "float_bytes"), ("map", "map_zero")
OF_CAMERA = ("image", "depth")
HOLES = ("hole_nan", "hole_inf", "hole_-inf", "hole_-1", "hole_65504")
CLASSES = ("hand",)
BUILT = {build.__name__: build for build in small.BUILDERS}
CLOUDS: dict[str, Callable[[Numbers], bytes]] = {
    "ply": partial(ply, "binary_little_endian"),
    "ply_ascii": partial(ply, "ascii"),
    **{f"pcd{form and '_'}{form}": partial(pcd, form or "binary") for form in ("", "ascii", "binary_compressed")},
    "npy": npy,
    "npz": lambda n: cloud_samples.npz(points=n.rows()[0], colors=n.rows()[1]),
    "bin": lambda n: np.c_[n.rows()[::2]].astype("<f4").tobytes(),
    "las": partial(las, False),
    "laz": partial(las, True),
}
TARGETS: list[Target] = [
    cloud("ply", *FLOATS, *COLOURS, *MAP, "share_bytes"),
    cloud("ply_ascii", *FLOATS, *COLOURS, *MAP, "share_words"),
    cloud("pcd", *FLOATS, "words", *MAP, "share_bytes"),
    cloud("pcd_ascii", *FLOATS, "words", "float_bytes", *MAP),
    cloud("pcd_binary_compressed"),
    cloud("npy", *FLOATS, "floats", *MAP),
    cloud("npz", *FLOATS, *COLOURS, *MAP),
    cloud("bin", *FLOATS, "share_bytes"),
    cloud("las", "words", *MAP),
    cloud("laz", "words", *MAP),
    Target("rgbd", write_rgbd, read_recording, OF_CAMERA, ("words", "hole_65535"), ("nfd",)),
    Target("tum_rgbd", write_tum, read_recording, OF_CAMERA, ("words", "hole_65535"), ("backslash",)),
    Target("record3d", partial(write_phone, phone_samples.write_record3d), read_phone, (), HOLES),
    Target("stray_scanner", partial(write_phone, phone_samples.write_stray_scanner), read_phone),
    Target("bag_16UC1", partial(write_bag, "16UC1"), read_bag, OF_CAMERA, ("hole_65535",)),
    Target("bag_32FC1", partial(write_bag, "32FC1"), read_bag, OF_CAMERA, HOLES),
    *map(sample, ("kitti_object", "kitti_raw", "sunrgbd_extracted", "argoverse2", "cloud_folder")),
    sample("nuscenes", "quaternion", "backslash"),
    *map(dataset, ("rcv", "sunrgbd", "labelcloud")),
    *(dataset(name, "degrees") for name in ("kitti", "kitti-tracking")),
    *(dataset(name, "quaternion") for name in ("openlabel", "nuscenes")),
    Target("export_boxes", write_json, partial(read_boxes, BoxFormat.BOXES), ("corners",)),
    Target("export_box_csv", write_csv, partial(read_boxes, BoxFormat.BOX_CSV), ("corners",), (), ("degrees",)),
    Target("coco", write_coco, partial(read_flat, FlatFormat.COCO), ("pixels",), (), ("nfd", "backslash")),
    Target("yolo", write_yolo, partial(read_flat, FlatFormat.YOLO), ("pixels",), (), ("nfd", "backslash")),
]  # fmt: skip
