"""The rcv dataset: round trips, self-contained files, and all-or-nothing writing."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import make_box, make_label, write

from annotator.formats.dataset_writing import DatasetItem, Detector
from annotator.formats.rcv import RcvManifest, labelled_frames, read_rcv
from annotator.recordings import open_recording
from annotator.types import BoxKind, Camera, Frame, Label, OrientedBox, PointCloud, ReviewState, Source, Suggestion
from annotator.types.errors import FormatError

CAMERA = Camera(6, 4, 5.0, 5.5, 2.5, 1.5, (0.1, -0.2, 0.001, 0.002, 0.05))
CLASSES, DETECTORS = ("hand", "Büro | 1"), (Detector("image", "yolo11n", "abc123"),)


def export(out: Path, items: Sequence[DatasetItem], **options: Any) -> RcvManifest:
    write("rcv", out, items, **({"classes": CLASSES, "detectors": DETECTORS} | options))
    return read_rcv(out).manifest


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


@pytest.mark.parametrize(("rgb", "reflectance"), [(True, True), (False, False)])
def test_frame_reads_back_bit_for_bit(tmp_path: Path, rgb: bool, reflectance: bool) -> None:
    frame, label = make_frame(rgb=rgb, reflectance=reflectance), auto_label()
    export(tmp_path / "out", [DatasetItem("rec", frame, [label])])
    dataset, back = read_rcv(tmp_path / "out"), open_recording(tmp_path / "out").frame(0)
    assert (len(dataset), back.key, back.timestamp_ns, dataset.place(0)) == (1, "rec-000001", 17, ("rec", 3))
    assert vars(back.camera) == vars(CAMERA)
    np.testing.assert_array_equal(back.up, [0, -1, 0])
    np.testing.assert_array_equal(back.rgb, frame.rgb)
    np.testing.assert_array_equal(back.cloud.xyz_m, frame.cloud.xyz_m)
    for have, want in ((back.cloud.rgb, frame.cloud.rgb), (back.cloud.reflectance, frame.cloud.reflectance)):
        assert (have is None) == (want is None)
        if have is not None and want is not None:
            np.testing.assert_array_equal(have, want)
    found = dataset.labelled(0)[1]
    (read,) = found.truths
    assert (read.label, read.score, read.track_id, read.box_kind) == ("hand", 0.75, 4, BoxKind.SILHOUETTE)
    assert found.states == (label.state,)
    (entry,) = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())["objects"]
    assert (entry["uid"], entry["author"], entry["time_ns"]) == (label.uid, label.author, label.time_ns)
    assert (entry["source"], entry["expected_iou_loss"]) == ("auto", 0.125)
    assert entry["suggestion"] == {"detector": "base detector", "fingerprint": "f00d", "corrected": True}


def test_json_has_the_box_as_matrix_quaternion_and_corners(tmp_path: Path) -> None:
    """A quarter turn about the camera's z: length along y, width along -x."""
    box = make_box((1.0, 2.0, 3.0), (0.0, 0.0, np.pi / 2), (4.0, 2.0, 1.0))
    export(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label(box, score=None, track_id=None)])])
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


def test_the_manifest_counts_frames_objects_and_points(tmp_path: Path) -> None:
    frames = [make_frame(key) for key in ("000001", "000002")]
    items = [
        DatasetItem("a", frames[0], [auto_label(uid="1"), auto_label(uid="2", label="Büro | 1", source=Source.MANUAL)]),
        DatasetItem("a", frames[1], []),
        DatasetItem("b/x", frames[0], [auto_label(uid="3", state=ReviewState.EDITED)]),
    ]
    manifest = export(tmp_path / "out", items)
    assert manifest.frames == ("a-000001", "a-000002", "b_x-000001")
    assert (manifest.counts.frames, manifest.counts.objects, manifest.counts.points) == (3, 3, 15)
    assert manifest.counts.objects_by_class == {"hand": 2, "Büro | 1": 1}
    assert manifest.counts.objects_by_state == {"proposed": 0, "accepted": 2, "edited": 1, "rejected": 0}
    assert manifest.counts.objects_by_source == {"manual": 1, "auto": 2, "imported": 0}
    assert manifest.counts.objects_by_recording == {"a": 2, "b/x": 1}
    assert [use.recordings for use in manifest.cameras] == [("a", "b/x")]
    assert manifest.detectors == DETECTORS


def test_readme_describes_every_field_and_its_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    export(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label()])])
    text = (tmp_path / "out/README.md").read_text(encoding="utf-8")
    entry = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())
    for name in (*entry["objects"][0], "up", "camera", "timestamp_ns"):
        assert f"`{name}`" in text
    assert r"Büro \| 1" in text
    (code,) = re.findall(r"Example, in Python:\n\n((?:    .*\n|\n)+)", text)
    monkeypatch.chdir(tmp_path / "out")
    exec(textwrap.dedent(code), {})
    assert capsys.readouterr().out.startswith("hand accepted [")


def edit(path: Path, **changes: Any) -> None:
    content = json.loads(path.read_text())
    target = content["objects"][0] if "objects" in content and "objects" not in changes else content
    target.update(changes)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("file", "changes", "says"),
    [
        ("labels/rec-000001.json", {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "quaternion and rotation disagree"),
        ("labels/rec-000001.json", {"center": [9, 9, 9]}, "corners disagree"),
        ("labels/rec-000001.json", {"objects": [], "image": "../../secret.png"}, "leads out of the folder"),
        ("dataset.json", {"version": 2}, "version"),
        ("dataset.json", {"frames": []}, "frames must list 1 different ids"),
    ],
)
def test_errors_of_a_broken_dataset_name_the_place(
    tmp_path: Path, file: str, changes: dict[str, Any], says: str
) -> None:
    out = tmp_path / "out"
    export(out, [DatasetItem("rec", make_frame(), [auto_label()])])
    edit(out / file, **changes)
    with pytest.raises(FormatError, match=re.escape(says)):
        read_rcv(out).labelled(0)


def test_a_frame_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    items = [DatasetItem("rec", make_frame(key), [auto_label()]) for key in ("a", "b")]
    _, second = export(tmp_path / "out", items).frames
    edit(tmp_path / f"out/labels/{second}.json", key="a", objects=[])
    with pytest.raises(FormatError, match="the frame rec/a has labels twice"):
        labelled_frames(tmp_path / "out")
