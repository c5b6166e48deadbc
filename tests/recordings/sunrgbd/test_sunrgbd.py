"""SUN RGB-D in both layouts, synthetic and real: camera, cloud and boxes agree with the data set's formulas."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_recordings import sunrgbd_extracted
from sunrgbd_samples import DEPTH_MM, IMAGE, WIDTH, A, upright_points, write_scene

from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.types import Frame
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.recorded.reading import has_truth, load_truth

LABEL = "night_stand 1 2 30 20 0.4 2.5 -0.3 0.3 0.5 0.4 0.6 0.8\n\nbed 0 0 9 9 0 3 -0.5 1 1.2 0.5 -1 0\n"


KEYS = ("000001", "000002")


@pytest.fixture(params=["depth", "points"])
def extracted(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Frames 000001 and 000002 of VoteNet's layout, clouds as .mat or .npz."""
    (tmp_path / "label").mkdir()
    for key in KEYS:
        (tmp_path / "label" / f"{key}.txt").write_text(LABEL)
    sunrgbd_extracted(tmp_path, KEYS, request.param)
    return tmp_path


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "SUNRGBD" / "kv2" / "align_kv2" / "2014-12-19_15-53-20_094959634447"
    write_scene(path)
    return path


def check_frame(frame: Frame) -> None:
    """Checks the frame that both layouts must give."""
    xyz, rgb = upright_points()
    np.testing.assert_allclose(frame.T_camera_label.inv().apply(frame.cloud.xyz_m.astype(float)), xyz, atol=1e-5)
    np.testing.assert_array_equal(frame.cloud.rgb, rgb)
    np.testing.assert_allclose(frame.depth_m, DEPTH_MM / 1000, atol=1e-6)
    v, u = np.nonzero(DEPTH_MM)
    np.testing.assert_array_equal(frame.cloud.pixel_index, v * WIDTH + u)
    np.testing.assert_allclose(project(frame.camera, frame.cloud.xyz_m), np.c_[u, v], atol=1e-3)
    np.testing.assert_allclose(frame.T_camera_label.apply([0, 0, 1]), frame.up, atol=1e-9)
    assert frame.up @ [0, -1, 0] > 0.9
    np.testing.assert_array_equal(frame.rgb, IMAGE)


def test_an_extracted_frame_is_read(extracted: Path):
    recording = open_recording(extracted)
    assert (recording.format, recording.keys) == ("sunrgbd_extracted", ("000001", "000002"))
    check_frame(recording.frame(1))


def test_a_scene_and_folders_of_scenes_are_read(scene: Path, tmp_path: Path):
    check_frame(open_recording(scene).frame(0))
    second = scene.with_name("2014-12-19_15-53-21")
    write_scene(second)
    (tmp_path / "SUNRGBD" / "readme.txt").touch()
    for root, prefix in (
        (tmp_path / "SUNRGBD", "kv2__align_kv2__"),
        (scene.parents[1], "align_kv2__"),
        (scene.parent, ""),
    ):
        recording = open_recording(root)
        assert (recording.format, recording.is_sequence) == ("sunrgbd_scenes", False)
        assert recording.keys == (f"{prefix}{scene.name}", f"{prefix}{second.name}")
        check_frame(recording.frame(1))
        assert [t.label for t in load_truth(recording, 1, recording.frame(1))] == ["night_stand"]


def test_extracted_labels_agree_with_votenets_boxes(extracted: Path):
    recording = open_recording(extracted)
    frame = recording.frame(0)
    stand, bed = load_truth(recording, 0, frame)
    assert (stand.label, bed.label) == ("night_stand", "bed")
    box = stand.box.transformed(frame.T_camera_label.inv())
    np.testing.assert_allclose(box.center_m, [0.4, 2.5, -0.3], atol=1e-9)
    np.testing.assert_allclose(box.size_m, [1.0, 0.6, 0.8])
    # VoteNet: heading = -atan2(oy, ox); the length is along rotz(-heading) x
    np.testing.assert_allclose(box.rotation, Rotation.from_euler("z", np.arctan2(0.8, 0.6)).as_matrix(), atol=1e-9)


def test_scene_labels_agree_with_the_toolbox(scene: Path):
    recording = open_recording(scene)
    frame = recording.frame(0)
    (truth,) = load_truth(recording, 0, frame)
    box = truth.box.transformed(frame.T_camera_label.inv())
    # y points down in the file; the orientation points to the first edge, here towards the camera
    np.testing.assert_allclose(box.center_m, [0.5, 3.0, -0.25], atol=1e-9)
    np.testing.assert_allclose(box.size_m, [2.0, 1.0, 1.5])
    np.testing.assert_allclose(box.rotation[:, 0], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(box.rotation[:, 2], [0, 0, 1], atol=1e-9)


def test_filled_depth_is_read_if_raw_depth_is_missing(scene: Path):
    (scene / "depth").rename(scene / "depth_bfx")
    check_frame(open_recording(scene).frame(0))


def test_scenes_without_annotations_have_no_truth(scene: Path):
    shutil.rmtree(scene / "annotation3Dfinal")
    assert not has_truth(open_recording(scene))
    write_scene(scene.with_name(f"{scene.name}-later"))
    assert has_truth(open_recording(scene.parent)), "it is enough if some scenes have annotations"


def test_a_scene_without_its_image_is_an_error_that_names_it(scene: Path):
    next((scene / "image").iterdir()).unlink()
    with pytest.raises(FrameError, match=rf"{scene.name}.*has no .png or .jpg or .jpeg file"):
        open_recording(scene).frame(0)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"X": [0, 1, 3, 0]}, "is not a rectangle"),
        ({"Ymax": -0.5}, "sizes must be positive"),
        ({"Ymin": None}, "objects.0.polygon.0.Ymin"),
    ],
)
def test_errors_of_scene_labels_name_the_field(scene: Path, change: dict[str, object], complaint: str):
    path = scene / "annotation3Dfinal" / "index.json"
    content = json.loads(path.read_text())
    content["objects"][0]["polygon"][0] |= change
    path.write_text(json.dumps(content))
    recording = open_recording(scene)
    with pytest.raises(FormatError, match=complaint) as caught:
        load_truth(recording, 0, recording.frame(0))
    assert caught.value.path == path


@pytest.mark.shared
def test_the_real_frame_is_the_same_in_both_layouts(shared: Path, tmp_path: Path):
    data = shared / "data" / "sunrgbd"
    recording = open_recording(data / "sunrgbd_trainval")
    frame = recording.frame(0)
    assert (frame.key, frame.rgb.shape, frame.depth_m is None) == ("000001", (530, 730, 3), False)
    truths = load_truth(recording, 0, frame)
    assert [t.label for t in truths] == ["bed", "night_stand", "ottoman", "dresser_mirror", "dresser", "lamp"]
    # the same boxes, as written by frustum-pointnets
    boxes = json.loads((data / "imvotenet" / "boxes.json").read_text())["000001"]
    bed = truths[0].box.transformed(frame.T_camera_label.inv())
    theirs = next(each for each in boxes if each["class"] == "bed")
    np.testing.assert_allclose(bed.center_m, theirs["centroid"], atol=1e-3)
    corners = {tuple(np.sign(c)) for c in (np.array(theirs["bev_corners"]) - bed.center_m[:2]) @ bed.rotation[:2, :2]}
    assert len(corners) == 4
    np.testing.assert_allclose(sorted(bed.size_m), sorted(theirs["size"]), atol=1e-3)
    # the same frame as a raw scene
    scene = tmp_path / "scene"
    for name in ("image", "depth", "extrinsics"):
        (scene / name).mkdir(parents=True)
    shutil.copy(data / "raw" / "image" / "000001.jpg", scene / "image")
    shutil.copy(data / "raw" / "depth" / "000001.png", scene / "depth")
    Rtilt, matrix = (
        np.array(line.split(), float).reshape(3, 3).T
        for line in (data / "imvotenet" / "calib" / "000001.txt").read_text().splitlines()
    )
    (scene / "intrinsics.txt").write_text(" ".join(map(str, matrix.ravel())))
    np.savetxt(scene / "extrinsics" / "a.txt", np.c_[A.T @ Rtilt @ A, np.zeros(3)])
    raw = open_recording(scene).frame(0)
    # the extraction ends at 8 m
    np.testing.assert_allclose(np.minimum(raw.depth_m, 8), frame.depth_m, atol=1e-4)
    np.testing.assert_allclose(raw.T_camera_label.as_matrix(), frame.T_camera_label.as_matrix(), atol=1e-4)
    second = open_recording(data / "imvotenet").frame(1)
    assert (second.key, second.depth_m is None) == ("000002", False)
