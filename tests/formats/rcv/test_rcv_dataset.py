"""The rcv dataset: round trips, self-contained files, and all-or-nothing writing."""

from __future__ import annotations

import json
import re
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import BOXES, assert_same_box, make_box, make_label
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.rcv import RcvDetector, RcvInfo, RcvOptions, export_rcv, read_rcv
from annotator.types import BoxKind, Camera, Frame, Label, OrientedBox, PointCloud, ReviewState, Source, Suggestion
from annotator.types.errors import FormatError, FrameError

CAMERA = Camera(6, 4, 5.0, 5.5, 2.5, 1.5, (0.1, -0.2, 0.001, 0.002, 0.05))
INFO = RcvInfo(
    classes=("hand", "Büro | 1"),
    detectors=(RcvDetector(role="image", name="yolo11n", fingerprint="abc123"),),
    generator="annotator 0.1.0",
)


def auto_label(box: OrientedBox | None = None, **changes: Any) -> Label:
    """A label with all optional fields."""
    known = {"score": 0.75, "source": Source.AUTO, "time_ns": 1_700_000_000_123_456_789, "track_id": 4}
    known |= {"expected_iou_loss": 0.125, "suggestion": Suggestion("base detector", "f00d", corrected=True)}
    known |= {"box_kind": BoxKind.SILHOUETTE}
    return make_label(box, **{**known, **changes})


def make_frame(key: str = "000001", *, rgb: bool = True, reflectance: bool = False, n: int = 5) -> Frame:
    rng = np.random.default_rng(len(key) + n)
    cloud = PointCloud(
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.integers(0, 256, (n, 3), np.uint8) if rgb else None,
        rng.random(n, np.float32) if reflectance else None,
    )
    image = rng.integers(0, 256, (4, 6, 3), np.uint8)
    return Frame(key, 3, CAMERA, image, cloud, up=np.array([0.0, -1.0, 0.0]), timestamp_ns=17)


def facts(label: Label) -> tuple[object, ...]:
    return (
        label.uid, label.label, label.score, label.source, label.state, label.author, label.time_ns, label.track_id,
        label.expected_iou_loss, label.suggestion, label.box_kind,
    )  # fmt: skip


@pytest.mark.parametrize("rgb", [True, False])
@pytest.mark.parametrize("reflectance", [True, False])
@pytest.mark.parametrize("n", [0, 5])
def test_frame_reads_back_bit_for_bit(tmp_path: Path, rgb: bool, reflectance: bool, n: int) -> None:
    frame = make_frame(rgb=rgb, reflectance=reflectance, n=n)
    label = auto_label()
    export_rcv(tmp_path / "out", [DatasetItem("rec", frame, [label])], INFO)

    dataset = read_rcv(tmp_path / "out")
    assert len(dataset) == 1
    back = dataset.frame(0)
    assert (back.id, back.recording) == ("rec-000001", "rec")
    assert (back.frame.key, back.frame.index, back.frame.timestamp_ns) == ("000001", 3, 17)
    assert vars(back.frame.camera) == vars(CAMERA)
    assert back.frame.up is not None
    np.testing.assert_array_equal(back.frame.up, [0, -1, 0])
    np.testing.assert_array_equal(back.frame.rgb, frame.rgb)
    np.testing.assert_array_equal(back.frame.cloud.xyz_m, frame.cloud.xyz_m)
    for have, want in (
        (back.frame.cloud.rgb, frame.cloud.rgb),
        (back.frame.cloud.reflectance, frame.cloud.reflectance),
    ):
        assert (have is None) == (want is None)
        if have is not None and want is not None:
            np.testing.assert_array_equal(have, want)
    assert facts(back.labels[0]) == facts(label)
    assert_same_box(back.labels[0].box, label.box)


@settings(max_examples=30, deadline=None)
@given(st.lists(BOXES, max_size=3))
def test_repeated_round_trips_do_not_change_labels(wanted: list[OrientedBox]) -> None:
    labels: tuple[Label, ...] = tuple(auto_label(box, uid=f"u{k}") for k, box in enumerate(wanted))
    first = labels
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(3):
            out = Path(folder, str(turn))
            export_rcv(out, [DatasetItem("rec", make_frame(), labels)], INFO)
            labels = read_rcv(out).labels(0)
    for have, want in zip(labels, first, strict=True):
        assert facts(have) == facts(want)
        assert_same_box(have.box, want.box)


def test_json_has_the_box_as_matrix_quaternion_and_corners(tmp_path: Path) -> None:
    """A quarter turn about the camera's z: length along y, width along -x."""
    box = make_box((1.0, 2.0, 3.0), (0.0, 0.0, np.pi / 2), (4.0, 2.0, 1.0))
    export_rcv(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label(box, score=None, track_id=None)])], INFO)
    content = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())
    (entry,) = content["objects"]
    assert entry["center"] == [1.0, 2.0, 3.0]
    assert entry["size"] == [4.0, 2.0, 1.0]
    np.testing.assert_allclose(entry["rotation"], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(entry["quaternion"], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
    corners = np.array(entry["corners"])
    assert corners.shape == (4, 8)
    np.testing.assert_allclose(corners[:, 0], [2.0, 0.0, 2.5, 1], atol=1e-12)  # ---
    np.testing.assert_allclose(corners[:, 1], [2.0, 4.0, 2.5, 1], atol=1e-12)  # +--
    np.testing.assert_allclose(corners[:, 6], [0.0, 4.0, 3.5, 1], atol=1e-12)  # +++
    assert (entry["score"], entry["track_id"], entry["source"], entry["state"]) == (None, None, "auto", "accepted")
    assert content["camera"]["distortion"] == [0.1, -0.2, 0.001, 0.002, 0.05]


def test_corners_follow_the_order_in_the_manifest(tmp_path: Path) -> None:
    manifest = export_rcv(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label()])], INFO)
    entry = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())["objects"][0]
    signs = np.array([[1 if sign == "+" else -1 for sign in word] for word in manifest.conventions.corner_order])
    by_hand = np.array(entry["center"]) + (signs * np.array(entry["size"]) / 2) @ np.array(entry["rotation"]).T
    np.testing.assert_allclose(np.array(entry["corners"])[:3].T, by_hand, atol=1e-12)


@pytest.mark.parametrize("reflectance", [True, False])
def test_open3d_reads_the_cloud(tmp_path: Path, reflectance: bool) -> None:
    import open3d

    frame = make_frame(reflectance=reflectance)
    export_rcv(tmp_path / "out", [DatasetItem("rec", frame, [])], INFO)
    cloud = open3d.t.io.read_point_cloud(tmp_path / "out/clouds/rec-000001.ply")
    np.testing.assert_array_equal(cloud.point.positions.numpy(), frame.cloud.xyz_m)
    np.testing.assert_array_equal(cloud.point.colors.numpy(), frame.cloud.rgb)
    if frame.cloud.reflectance is not None:
        np.testing.assert_array_equal(cloud.point.reflectance.numpy()[:, 0], frame.cloud.reflectance)


def test_the_manifest_counts_frames_objects_and_points(tmp_path: Path) -> None:
    frames = [make_frame(key) for key in ("000001", "000002")]
    items = [
        DatasetItem("a", frames[0], [auto_label(uid="1"), auto_label(uid="2", label="Büro | 1", source=Source.MANUAL)]),
        DatasetItem("a", frames[1], []),
        DatasetItem("b/x", frames[0], [auto_label(uid="3", state=ReviewState.EDITED)]),
    ]
    written = export_rcv(tmp_path / "out", iter(items), INFO)
    manifest = read_rcv(tmp_path / "out").manifest
    assert manifest == written
    assert manifest.frames == ("a-000001", "a-000002", "b_x-000001")
    assert (manifest.counts.frames, manifest.counts.objects, manifest.counts.points) == (3, 3, 15)
    assert manifest.counts.objects_by_class == {"hand": 2, "Büro | 1": 1}
    assert manifest.counts.objects_by_state == {"proposed": 0, "accepted": 2, "edited": 1, "rejected": 0}
    assert manifest.counts.objects_by_source == {"manual": 1, "auto": 2, "imported": 0}
    assert manifest.counts.objects_by_recording == {"a": 2, "b/x": 1}
    assert [use.recordings for use in manifest.cameras] == [("a", "b/x")]
    assert manifest.detectors == INFO.detectors


def test_readme_describes_every_field_and_its_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    export_rcv(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label()])], INFO)
    text = (tmp_path / "out/README.md").read_text(encoding="utf-8")
    entry = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())
    for name in (*entry["objects"][0], "up", "camera", "timestamp_ns"):
        assert f"`{name}`" in text
    assert r"Büro \| 1" in text
    (code,) = re.findall(r"Example, in Python:\n\n((?:    .*\n|\n)+)", text)
    monkeypatch.chdir(tmp_path / "out")
    exec(textwrap.dedent(code), {})
    assert capsys.readouterr().out.startswith("hand accepted [")


def test_frames_are_written_one_by_one(tmp_path: Path) -> None:
    """All earlier frames are on disk when the next frame is requested."""

    def items() -> Iterator[DatasetItem]:
        for number in range(3):
            (part,) = tmp_path.glob(".out.part-*")
            assert len(list((part / "labels").iterdir())) == number
            yield DatasetItem("rec", make_frame(f"{number:06d}"), [])

    export_rcv(tmp_path / "out", items(), INFO)
    assert len(read_rcv(tmp_path / "out")) == 3


def test_different_names_that_look_alike_get_different_files(tmp_path: Path) -> None:
    items = [DatasetItem(name, make_frame(), []) for name in ("a b", "a/b", "A_B", "../a")]
    manifest = export_rcv(tmp_path / "out", items, INFO)
    assert len({frame_id.casefold() for frame_id in manifest.frames}) == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    assert [read_rcv(tmp_path / "out").frame(i).recording for i in range(4)] == ["a b", "a/b", "A_B", "../a"]


def failing_items(error: BaseException) -> Iterator[DatasetItem]:
    yield DatasetItem("rec", make_frame(), [])
    raise error


@pytest.mark.parametrize("error", [FrameError(Path("x.png"), "truncated"), KeyboardInterrupt()])
def test_a_failed_export_leaves_nothing(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises(type(error)):
        export_rcv(tmp_path / "out", failing_items(error), INFO)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_overwrite_leaves_the_old_dataset(tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_rcv(out, [DatasetItem("old", make_frame(), [])], INFO)
    with pytest.raises(FrameError):
        export_rcv(out, failing_items(FrameError(Path("x.png"), "truncated")), INFO, overwrite=True)
    assert read_rcv(out).frame(0).recording == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FormatError, match="No space left"):
        export_rcv(tmp_path / "out", [DatasetItem("rec", make_frame(), [])], INFO)
    assert list(tmp_path.iterdir()) == []


def test_only_datasets_and_empty_folders_are_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    items = [DatasetItem("rec", make_frame(), [])]
    out.mkdir(parents=True)
    export_rcv(out, items, INFO)  # an empty folder is free
    with pytest.raises(FormatError, match="is not empty"):
        export_rcv(out, items, INFO)
    export_rcv(out, [DatasetItem("new", make_frame(), [])], INFO, overwrite=True)
    assert read_rcv(out).frame(0).recording == "new"
    assert [path.name for path in out.parent.iterdir()] == ["out"]

    other = tmp_path / "photos"
    other.mkdir()
    (other / "keep.txt").write_text("mine")
    with pytest.raises(FormatError, match="is not empty"):  # overwriting is for datasets only
        export_rcv(other, items, INFO, overwrite=True)
    with pytest.raises(FormatError, match="is not a folder"):
        export_rcv(other / "keep.txt", items, INFO, overwrite=True)
    assert (other / "keep.txt").read_text() == "mine"


def test_invalid_items_are_errors_and_nothing_is_written(tmp_path: Path) -> None:
    item = DatasetItem("rec", make_frame(), [])
    cases: list[tuple[list[DatasetItem], str]] = [
        ([], "no frame to export"),
        ([item, item], "rec, frame 000001: the frame is exported twice"),
        ([DatasetItem("rec", make_frame(), [auto_label(label="cat")])], "label 'cat' is not one of the classes hand"),
    ]
    for items, says in cases:
        with pytest.raises(FormatError, match=says):
            export_rcv(tmp_path / "out", items, INFO)
        assert list(tmp_path.iterdir()) == []


def test_images_can_be_jpegs(tmp_path: Path) -> None:
    info = RcvInfo(("hand",), (), "annotator 0.1.0", RcvOptions(image_format="jpg", jpeg_quality=100))
    flat = Frame("k", 0, CAMERA, np.full((4, 6, 3), (200, 100, 50), np.uint8), make_frame().cloud)
    export_rcv(tmp_path / "out", [DatasetItem("rec", flat, [])], info)
    assert (tmp_path / "out/images/rec-k.jpg").is_file()
    back = read_rcv(tmp_path / "out").frame(0).frame
    assert np.abs(back.rgb.astype(int) - [200, 100, 50]).max() <= 3
    assert back.up is None


def edit(path: Path, **changes: Any) -> None:
    content = json.loads(path.read_text())
    target = content["objects"][0] if "objects" in content and "objects" not in changes else content
    target.update(changes)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("file", "changes", "says"),
    [
        ("labels/rec-000001.json", {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "quaternion and rotation disagree"),
        ("labels/rec-000001.json", {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "proper rotation matrix"),
        ("labels/rec-000001.json", {"center": [9, 9, 9]}, "corners disagree"),
        ("labels/rec-000001.json", {"size": [1, 1, 0]}, "objects.0.size.2"),
        ("labels/rec-000001.json", {"score": 2}, "objects.0.score"),
        ("labels/rec-000001.json", {"expected_iou_loss": -1}, "objects.0.expected_iou_loss"),
        ("labels/rec-000001.json", {"colour": "red"}, "objects.0.colour"),
        ("labels/rec-000001.json", {"objects": [], "id": "x"}, "has the id 'x'"),
        ("labels/rec-000001.json", {"objects": [], "image": "../../secret.png"}, "leads out of the folder"),
        ("labels/rec-000001.json", {"objects": [], "points": 6}, "holds 5 points, but rec-000001.json says 6"),
        ("dataset.json", {"version": 2}, "version"),
        ("dataset.json", {"frames": []}, "frames must list 1 different ids"),
    ],
)
def test_errors_of_a_broken_dataset_name_the_place(
    tmp_path: Path, file: str, changes: dict[str, Any], says: str
) -> None:
    out = tmp_path / "out"
    export_rcv(out, [DatasetItem("rec", make_frame(), [auto_label()])], INFO)
    edit(out / file, **changes)
    with pytest.raises(FormatError, match=re.escape(says)):
        read_rcv(out).frame(0)


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("images/rec-000001.png", "image"),
        ("clouds/rec-000001.ply", "PLY|points|layout"),
        ("labels/rec-000001.json", "JSON"),
        ("dataset.json", "JSON"),
    ],
)
def test_truncated_and_missing_files_are_named(tmp_path: Path, file: str, says: str) -> None:
    out = tmp_path / "out"
    export_rcv(out, [DatasetItem("rec", make_frame(), [auto_label()])], INFO)
    whole = (out / file).read_bytes()
    for end in (0, 20, len(whole) - 3):
        (out / file).write_bytes(whole[:end])
        with pytest.raises(FormatError, match=says) as caught:
            read_rcv(out).frame(0)
        assert caught.value.path == out / file
    (out / file).unlink()
    with pytest.raises(FormatError, match=r"cannot be read|has a dataset\.json"):
        read_rcv(out).frame(0)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [(b"float x", b"double x"), (b"element vertex 5", b"element vertex "), (b"vertex 5", b"vertex  5")],
    ids=["another type", "no count", "another layout"],
)
def test_a_foreign_ply_is_refused(tmp_path: Path, ours: bytes, theirs: bytes) -> None:
    out = tmp_path / "out"
    export_rcv(out, [DatasetItem("rec", make_frame(), [])], INFO)
    path = out / "clouds/rec-000001.ply"
    assert ours in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(ours, theirs))
    with pytest.raises(FormatError, match="does not have the layout"):
        read_rcv(out).frame(0)
