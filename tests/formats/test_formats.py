"""Every format of the table: what it holds comes back, what it loses is counted, and a dataset is written whole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import assert_same_box, make_box, make_item, make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetItem, FileNames, Format, Losses, Lost
from annotator.formats.table import FORMATS, WRITERS, ExportFormat
from annotator.recordings import open_recording
from annotator.types import Camera, PointCloud, ReviewState, Truth
from annotator.types.errors import FormatError
from annotator.types.label import Said
from annotator.workflows.importing import BoxFormat, FlatFormat, format_of, read_labels
from annotator.workflows.importing.readers import READERS

DOCS = Path(__file__).resolve().parents[2] / "docs/formats.md"
SOLID = [name for name, format in WRITERS.items() if not format.flat]
# Format, options and precision of boxes, metres and radians.
TRIPS = [
    ("rcv", {}, 1e-9),
    ("kitti", {}, 0.0101),
    ("kitti-tracking", {}, 0.0101),
    ("sunrgbd", {}, 2e-6),
    ("openlabel", {}, 1e-9),
    ("labelcloud", {}, 3e-8),
    ("labelcloud", {"vertices": True}, 2e-7),
    ("nuscenes", {}, 1e-9),
    ("sustechpoints", {}, 1e-9),
]
# A camera that sees far to all sides.
WIDE = Camera(64, 48, 9.0, 9.0, 31.5, 23.5)
VALUES: list[dict[str, Any]] = [
    {},
    {"truncation": 0.25, "occlusion": 2, "pose": "standing up", "helmet": False, "number": 2**53, "mass": -81.125},
    {"truncation": 1.0, "occlusion": 3, "pose": "1.5", "helmet": True, "state": 'a.b, ä: "c"\n', "mass": 7.0},
]
OF_FRAME = {"weather": "light rain", "night": False}
PLACE = RigidTransform.from_components([701_378.25, 4_485_513.5, 640.0], Rotation.from_rotvec([1, -0.5, 0.25]))
OTHER_PLACE = RigidTransform.from_components([701_377.0, 4_485_515.0, 640.5], Rotation.from_rotvec([1, -0.4, 0.5]))


def samples(rotations: Rotation) -> list[DatasetItem]:
    """Two frames, and boxes of these rotations (camera frame), with all that labels and frames may have."""
    rng = np.random.default_rng(0)
    said = (Said("theirs", "hand", make_box(), 0.25, 9),)
    places = [(tuple(rng.uniform((-2, -2, 6), (2, 2, 9))), tuple(rng.uniform(0.3, 2, 3))) for _ in rotations]
    labels = [
        make_label(
            make_box(places[number][0], tuple(each.as_rotvec()), places[number][1]),
            uid=f"u{number}", label=("hand", "night stand")[number % 2], score=0.5, track_id=number,
            attributes=VALUES[number], said=said if number else (),
            state=ReviewState.EDITED if number == 1 else ReviewState.ACCEPTED,
        )
        for number, each in enumerate(rotations)
    ]  # fmt: skip
    key = {"recording": "rec", "T_world_camera": PLACE, "camera": WIDE}
    return [
        make_item(labels, key="a", index=0, attributes=OF_FRAME, **key),
        make_item([], key="b", index=1, up=None, **key),
    ]


def turns(name: str) -> Rotation:
    upright = Rotation.from_euler("y", [[0.3], [2.0], [-1.2]]) * Rotation.from_matrix(
        [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
    )
    return upright if FORMATS[name].boxes == "upright" else Rotation.random(3, rng=np.random.default_rng(1))


def read(name: str, out: Path, item: DatasetItem, **changes: Any) -> list[Truth]:
    return read_labels(BoxFormat(name), out).truths(f"rec/{item.frame.key}", replace(item.frame, **changes))


@pytest.mark.parametrize(("name", "options", "precision"), TRIPS)
def test_what_a_format_holds_comes_back_any_number_of_times(
    tmp_path: Path, name: str, options: dict[str, Any], precision: float
) -> None:
    format, items = FORMATS[name], samples(turns(name))
    given, labels, first = items[0].labels, items[0].labels, list[Truth]()
    for trip in range(3):
        out = tmp_path / f"{trip}"
        counts = write(name, out, [replace(items[0], labels=labels), items[1]], **options).counts
        assert counts == {"hand": 2, "night stand": 1}
        assert read(name, out, items[1]) == []
        found = read(name, out, items[0])
        for have, want in zip(found, given, strict=True):
            assert_same_box(have.box, want.box, precision)
            values = {key: value for key, value in want.attributes.items() if key in (format.values or (key,))}
            # KITTI measures what nobody has said; in tracking files, a share is a level
            measured = {"truncation", "occlusion"} & set(format.values or ()) if trip or not values else set()
            measured |= {"truncation"} if name == "kitti-tracking" else set()
            # others read a text that looks like a number as one, and the project's attributes have kinds
            as_text = str if name in ("nuscenes", "sustechpoints") else lambda value: value
            kept, wanted = (
                {k: as_text(v) for k, v in each.items() if k not in measured} for each in (have.attributes, values)
            )
            assert kept == (wanted if format.values != () else {})
            # OpenLABEL's numbers have no kind
            kinds = ([type(each[key]) for key in sorted(kept)] for each in (kept, wanted))
            assert name == "openlabel" or len({*map(tuple, kinds)}) == 1
            assert have.label == want.label
            assert have.track_id == (None if Lost.TRACK in format.loses else want.track_id)
            assert have.score == (None if Lost.SCORE in format.loses else want.score)
            assert [(each.source, each.label, each.score, each.track_id) for each in have.said] == (
                [] if Lost.SAID in format.loses else [(s.source, s.label, s.score, s.track_id) for s in want.said]
            )
        # what a format rounds, it rounds once
        for have, before in zip(found, first, strict=False):
            assert_same_box(have.box, before.box, max(1e-9, min(precision, 1e-7)))
        first = first or found
        labels = [
            replace(label, box=each.box, attributes=each.attributes) for label, each in zip(given, found, strict=True)
        ]
    values_of = getattr(read_labels(BoxFormat(name), out), "values_of", lambda _: {})
    assert dict(values_of("rec/a")) == (OF_FRAME if format.of_frames else {})


@pytest.mark.parametrize("name", SOLID)
def test_boxes_go_where_their_camera_is_if_the_format_holds_its_place_in_a_map(tmp_path: Path, name: str) -> None:
    items = samples(turns(name))
    write(name, tmp_path / "out", items)
    here, there, corrected = (
        read(name, tmp_path / "out", items[0], T_world_camera=T, in_map=in_map)
        for T, in_map in ((PLACE, True), (OTHER_PLACE, True), (OTHER_PLACE, False))
    )
    moved = RigidTransform.identity() if Lost.ORIGIN in FORMATS[name].loses else OTHER_PLACE.inv() * PLACE
    for one, other, before_camera in zip(here, there, corrected, strict=True):
        assert_same_box(other.box, one.box.transformed(moved), 1e-6)
        # poses that were corrected after the export move no box before its camera
        assert_same_box(before_camera.box, one.box, 1e-6)


def test_a_world_whose_z_is_not_up_is_none_of_nuscenes(tmp_path: Path) -> None:
    """That of an odometry's first image; z of the global frame is read as up."""
    level = RigidTransform.from_rotation(Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    place = RigidTransform.from_translation([1, 2, 3])
    for T, lost in ((place, 1), (place * level, 0)):
        item = make_item([make_label(track_id=1)], recording="rec", T_world_camera=T, camera=WIDE)
        seen = PointCloud(np.array([[0, 0, 8.0], [1, 0, 9]], np.float32))
        items = [replace(item, frame=replace(item.frame, cloud=seen))]
        write("nuscenes", tmp_path / f"{lost}", items, losses := Losses())
        assert {loss.kind: loss.count for loss in losses.report()}.get(Lost.ORIGIN, 0) == lost
        recording = open_recording(tmp_path / f"{lost}")
        pose = recording.pose(0)
        assert (pose is None) == bool(lost)
        assert pose is None or np.allclose(pose.as_matrix(), T.as_matrix())
        np.testing.assert_allclose(recording.frame(0).up, [0, -1, 0], atol=1e-9)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", SOLID)
def test_what_a_format_loses_is_counted(tmp_path: Path, name: str) -> None:
    format, losses, items = FORMATS[name], Losses(), samples(turns("rcv"))
    lens = replace(items[0].frame, camera=replace(WIDE, distortion=(0.01, 0.0, 0.0, 0.0)), up=np.array([0.6, -0.8, 0]))
    write(name, tmp_path / "out", [replace(items[0], frame=lens), items[1]], losses)
    counted = {loss.kind: loss.count for loss in losses.report()}
    once = (Lost.LENS, Lost.GRAVITY, Lost.LEVEL, Lost.STATE)
    counts = dict.fromkeys(once, 1) | {Lost.SCORE: 3, Lost.TRACK: 3, Lost.SAID: 2, Lost.TIME: 2, Lost.ORIGIN: 2}
    counts[Lost.DEPTH_COLOR] = 2
    assert {kind: counted.get(kind, 0) for kind in counts} == {
        kind: count if kind in format.loses else 0 for kind, count in counts.items()
    }
    words = {"kitti": 2, "kitti-tracking": 2, "sunrgbd": 1}
    assert (Lost.NAME in counted) == (name in words)
    of_boxes = {"kitti": 8, "kitti-tracking": 10}.get(name, 0 if format.values is None else 12)
    assert counted.get(Lost.ATTRIBUTE, 0) == of_boxes + (0 if format.of_frames else 2)
    assert format.boxes != "upright" or Lost.TILT in counted


def documented() -> str:
    """The table of docs/formats.md: what each format holds, and what tells its folders."""
    head = ("format", "export", "boxes", "tracks", "scores", "states and sources", "map place", "attributes", "told by")
    rows = [head, ("---",) * len(head), *(_documented(name, format) for name, format in FORMATS.items())]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def _documented(name: str, format: Format) -> tuple[str, ...]:
    values = "all" if format.values is None else ", ".join(format.values) or "none"
    if values == "all" and not format.of_frames:
        values = "all, none of frames"
    holds = (Lost.TRACK, Lost.SCORE, Lost.STATE, Lost.ORIGIN)
    return (
        name,
        "yes" if format.summary else "no",
        format.boxes,
        *("no" if kind in format.loses else "yes" for kind in holds),
        values,
        ", ".join(f"`{mark}`" for mark in format.marks) or "the content of its files",
    )


def test_the_table_names_all_formats_and_is_that_of_the_documentation() -> None:
    assert set(FORMATS) == {*BoxFormat, *FlatFormat}
    written = {name for name, format in FORMATS.items() if format.writer or format.pictures}
    assert written == set(ExportFormat) == {name for name, format in FORMATS.items() if format.summary}
    assert set(READERS) == set(BoxFormat)
    assert documented() in DOCS.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["kitti", "kitti-tracking", "sunrgbd"])
def test_an_export_that_lists_its_classes_is_no_yolo_dataset(tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    write(name, out, [make_item([make_label(label="traffic cone")])], classes=("traffic cone",))
    assert "traffic cone" in (out / "classes.txt").read_text(encoding="utf-8")
    assert format_of(out) == name
    assert FORMATS[name].may_replace(out) and not FORMATS["yolo"].may_replace(out)
    (out / "labels").mkdir()
    (out / "labels" / "0.txt").write_text("0 0.5 0.5 0.1 0.1\n", encoding="utf-8")
    with pytest.raises(FormatError, match=f"could be {name} or yolo"):
        format_of(out)


@pytest.mark.parametrize("name", SOLID)
def test_only_older_exports_of_the_format_are_replaced(tmp_path: Path, name: str) -> None:
    items, out = samples(turns(name)), tmp_path / "deep" / "out"
    out.mkdir(parents=True)
    write(name, out, items)  # an empty folder is free
    with pytest.raises(FormatError, match="exists and is not empty"):
        write(name, out, items)
    write(name, out, items[:1], overwrite=True)
    assert list(read_labels(BoxFormat(name), out).frames) == ["rec/a"]
    write(name, tmp_path / "plain", [make_item([make_label()])], classes=("hand",))
    assert format_of(tmp_path / "plain") == name
    other = "openlabel" if name == "rcv" else "rcv"
    with pytest.raises(FormatError, match="exists and is not empty"):
        write(other, out, items, overwrite=True)
    # without these it could be the dataset of another program
    (out / ("dataset.json" if name == "rcv" else "frames.csv")).unlink()
    with pytest.raises(FormatError, match="exists and is not empty"):
        write(name, out, items, overwrite=True)
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_what_is_no_dataset_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/keep.txt").write_text("mine")
    with pytest.raises(FormatError, match="is not empty"):
        write("rcv", tmp_path / "photos", [make_item()], overwrite=True)
    with pytest.raises(FormatError, match="is not a folder"):
        write("rcv", tmp_path / "photos/keep.txt", [make_item()], overwrite=True)
    assert (tmp_path / "photos/keep.txt").read_text() == "mine"


def failing(error: BaseException) -> Iterator[DatasetItem]:
    yield make_item()
    raise error


def test_a_failed_export_leaves_nothing_and_an_older_one_as_it_was(tmp_path: Path) -> None:
    error = KeyboardInterrupt()
    with pytest.raises(type(error)):
        write("openlabel", tmp_path / "out", failing(error))
    assert list(tmp_path.iterdir()) == []
    write("openlabel", tmp_path / "out", [make_item([make_label()])])
    with pytest.raises(type(error)):
        write("openlabel", tmp_path / "out", failing(error), overwrite=True)
    assert len(read("openlabel", tmp_path / "out", make_item())) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_and_impossible_items_are_errors_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases: list[tuple[list[DatasetItem], str]] = [
        ([], "no frame to export"),
        ([make_item(), make_item()], "rec, frame 000003: the frame is exported twice"),
        ([make_item([make_label(label="cat")])], "label 'cat' is not one of the classes hand"),
    ]
    for items, says in cases:
        with pytest.raises(FormatError, match=says):
            write("rcv", tmp_path / "out", items)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FormatError, match="No space left"):
        write("rcv", tmp_path / "out", [make_item()])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["openlabel", "labelcloud", "nuscenes", "sustechpoints"])
def test_frames_without_points_and_parts_of_a_dataset_read_back(tmp_path: Path, name: str) -> None:
    item = make_item([make_label()], key="a", split="train")
    bare = replace(item, frame=replace(item.frame, cloud=PointCloud(np.zeros((0, 3), np.float32))))
    write(name, tmp_path / "out", [bare, make_item(key="b", index=4, split="val")])
    assert [len(read(name, tmp_path / "out", make_item(key=key))) for key in "ab"] == [1, 0]


def test_different_names_that_look_alike_get_different_files(tmp_path: Path) -> None:
    names = ("a b", "a/b", "A_B", "../a")
    write("openlabel", tmp_path / "out", [make_item(recording=name) for name in names])
    files = [path.name.casefold() for path in (tmp_path / "out/images").iterdir()]
    assert len(set(files)) == 4 and [path.name for path in tmp_path.iterdir()] == ["out"]
    assert set(read_labels(BoxFormat.OPENLABEL, tmp_path / "out").frames) == {f"{name}/000003" for name in names}


def test_long_names_make_valid_file_names_that_differ(tmp_path: Path) -> None:
    names = FileNames()
    stems = [names.add("\N{GREEK SMALL LETTER OMEGA}" * 127, "k" * 190 + end) for end in ("1", "2", "1")]
    assert len(set(stems)) == 3
    for stem in stems:
        assert not stem.startswith(".")
        (tmp_path / f".{stem}.json.{'0' * 32}.tmp").touch()
    assert names.add("take", "000") == "take-000"
