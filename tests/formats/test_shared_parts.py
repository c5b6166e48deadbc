"""What formats share: frames.csv, JSON, masks, units, links and archives made to do harm; CSV and boxes.json."""

from __future__ import annotations

import csv
import io
import json
import math
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_samples import make_item, make_label
from dataset_samples import write as export
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.box_files import read_boxes, read_upright_boxes, write_boxes
from annotator.formats.frame_names import FrameOrigin, dump_frames, parse_frames, read_frames
from annotator.formats.rcv import read_rcv
from annotator.formats.reading import Angles, Lengths, read_mask, read_object, text_files
from annotator.formats.sunrgbd import read_extracted_labels, read_scene_labels
from annotator.types.errors import FormatError, UnitError, UnitKind

# file names contain no NUL and no lone surrogates
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=8)


@given(st.lists(st.builds(FrameOrigin, WORDS, WORDS, WORDS, st.none() | WORDS), unique_by=lambda o: o.id))
@settings(deadline=None)
def test_written_frames_read_back(origins: list[FrameOrigin]) -> None:
    assert list(parse_frames(Path("frames.csv"), dump_frames(origins)).values()) == origins


# Texts that spreadsheets run as formulas, and those that look like escaped ones.
FORMULAS = ["=1+1", "+a", "-a", "@a", "\t=a", "\ra", "'=a", "'-5", '="x",y']


def test_a_spreadsheet_runs_no_cell() -> None:
    for name in FORMULAS:
        text = dump_frames([FrameOrigin("a", name, name, name)])
        assert next(csv.reader(io.StringIO(text.partition("\r\n")[2], newline="")))[1:] == [f"'{name}"] * 3
        assert list(parse_frames(Path("frames.csv"), text).values()) == [FrameOrigin("a", name, name, name)]
    for name in ("-5", "+0.5e-3", "12", "a=b", "'a", "a-1"):
        assert dump_frames([FrameOrigin(name, name, name)]).endswith(f"{name},{name},{name},\r\n")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("id,recording,key,split\n1,a,000,\n2,b\n", r"frames\.csv:3: needs the fields id, recording, key, split"),
        ("id,recording,key,split\n1,a,000,\n1,a,001,\n", r"frames\.csv:3: the id 1 occurs twice"),
        ('id,recording,key,split\n1,"a,000,\n', r"frames\.csv:2: is not valid CSV"),
    ],
)
def test_errors_name_the_line(text: str, problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        parse_frames(Path("frames.csv"), text)


def test_a_missing_or_unrelated_frames_csv_is_ignored(tmp_path: Path) -> None:
    assert read_frames(tmp_path) == {}
    (tmp_path / "frames.csv").write_text("time,exposure\n1,2\n")
    assert read_frames(tmp_path) == {}
    (tmp_path / "frames.csv").write_text("id,recording\n1,2\n")
    with pytest.raises(FormatError, match=r"frames\.csv:1: must begin with"):
        read_frames(tmp_path)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[1]", "must be a JSON object"),
        ('{"a"\n: 1,\n"b": [1,\n]}', "content.json:4: is not valid JSON"),
        ('{"a": 1, "a": 2}', "'a' occurs twice"),
        ('{"a": "\\ud800"}', "unpaired surrogate"),
        ('{"a": ' + "1" * 5000 + "}", "cannot be read"),
        ('{"a": ' + "[" * 100_000, "nested too deeply"),
        ('{"a": "\xff"}', "not UTF-8"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "content.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(FormatError, match=r"content\.json") as raised:
        read_object(path)
    assert problem in str(raised.value)
    with pytest.raises(FormatError):
        read_object(tmp_path / "missing.json")


def write(path: Path, mask: np.ndarray) -> Path:
    path.write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    return path


@pytest.mark.parametrize(
    ("written", "numbers"),
    [([0, 255], [0, 1]), ([0, 0], [0, 0]), ([0, 1], [0, 1]), ([0, 3], [0, 3]), ([2, 255], [2, 255])],
)
def test_object_numbers_are_read_and_a_single_255_becomes_1(tmp_path: Path, written: list[int], numbers: list[int]):
    mask = read_mask(write(tmp_path / "m.png", np.array([written], np.uint8)))
    assert mask.dtype == np.uint8
    assert mask.tolist() == [numbers]


def test_what_is_no_mask_is_an_error(tmp_path: Path) -> None:
    path = write(tmp_path / "m.png", np.random.default_rng(0).integers(0, 3, (50, 50)).astype(np.uint8))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(FormatError, match=r"m\.png: is not a valid mask: the image is damaged or truncated"):
        read_mask(path)
    for mask in (np.zeros((4, 4), np.uint16), np.zeros((4, 4, 3), np.uint8)):
        with pytest.raises(FormatError, match="one channel"):
            read_mask(write(path, mask))
    with pytest.raises(FormatError, match="cannot be read"):
        read_mask(tmp_path / "none.png")


FILE = Path("a.txt")
TURN = 2 * math.pi


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([], None),
        ([TURN, -6.28, 6.29], None),
        # OpenPCDet: rotation_y = -heading - pi/2, heading in pi/4 .. 9/4 pi
        ([-8.64, -2.36, -5.0], None),
        ([-90.0], r"-90 is no angle in radians.* \(1 of 1 angle other"),
        ([0.0, 2.0, 180.0, -270.0], r"-270 is no angle in radians.* \(2 of 3 angles other"),
    ],
)
def test_angles_beyond_one_and_a_half_turns_are_no_radians(values: list[float], said: str | None) -> None:
    angles = Angles()
    assert [angles.radians(value, FILE, line) for line, value in enumerate(values, 1)] == values
    if said is None:
        angles.require()
    else:
        with pytest.raises(UnitError, match=said) as caught:
            angles.require()
        worst = max(range(len(values)), key=lambda place: abs(values[place]))
        assert (caught.value.kind, caught.value.path, caught.value.line) == (UnitKind.ANGLE, FILE, worst + 1)
        assert "--angles degrees" in str(caught.value) and "--angles radians" in str(caught.value)


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ([(0.19, 0.08, 0.03)], None),
        ([(4, 2, 1.6), (4000, 2000, 1600), (5, 2, 2)], None),
        ([(0.004, 0.002, 0.0016)] * 2, r"2 of 2 boxes are shorter than 5 mm .* kilometres"),
    ],
)
def test_sizes_of_most_boxes_that_no_scene_has_are_no_metres(sizes: list[tuple[float, ...]], said: str | None) -> None:
    lengths = Lengths(np.array(size, float) for size in sizes)
    if said is None:
        lengths.require(FILE)
    else:
        with pytest.raises(UnitError, match=said):
            lengths.require(FILE)


HEAD = "image,class,cx,cy,cz,l,w,h,yaw,score"
ROW = "3,night_stand,-0.5,3.25,-0.75,1.5,2,1,-0.25,0.875"


def file_of(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "boxes.csv"
    path.write_text("\n".join(lines))
    return path


def test_rows_are_read(tmp_path: Path) -> None:
    (name, frame), *others = read_upright_boxes(file_of(tmp_path, HEAD, ROW, "", ROW + "\r"), scored=True).items()
    assert (name, others, len(frame.truths)) == ("3", [], 2)
    for truth in frame.truths:
        assert (truth.label, truth.score) == ("night_stand", 0.875)
        assert (truth.box.center_m.tolist(), truth.box.size_m.tolist()) == ([-0.5, 3.25, -0.75], [1.5, 2.0, 1.0])
        turn = [[math.cos(0.25), math.sin(0.25), 0], [-math.sin(0.25), math.cos(0.25), 0], [0, 0, 1]]
        np.testing.assert_allclose(truth.box.rotation, turn, atol=1e-12)
    without = read_upright_boxes(file_of(tmp_path, HEAD.removesuffix(",score"), ROW.removesuffix(",0.875")))
    assert without["3"].truths[0].score is None
    assert read_upright_boxes(file_of(tmp_path, HEAD), scored=True) == {}


def test_rows_that_are_no_boxes_are_refused(tmp_path: Path) -> None:
    for head, row, problem in (
        (HEAD.removesuffix(",score"), ROW, ":1: has no column score"),
        (HEAD, "3,bed", ":2: has 2 fields"),
        (HEAD, ROW.replace(",2,", ",-2,"), ":2: .*must be positive"),
    ):
        with pytest.raises(FormatError, match=problem):
            read_upright_boxes(file_of(tmp_path, head, row), scored=True)


UNIT = {"label": "hand", "center": [0, 0, 1], "size": [0.2, 0.1, 0.05], "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}


def put(folder: Path, content: object) -> Path:
    path = folder / "boxes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_frame_may_have_one_object_a_list_or_an_empty_list(tmp_path: Path):
    boxes = read_boxes(put(tmp_path, {"a": UNIT, "b": [UNIT, UNIT | {"track": 4, "note": "?"}], "c": []}))
    assert {key: len(truths) for key, truths in boxes.items()} == {"a": 1, "b": 2, "c": 0}
    (truth,) = boxes["a"]
    assert (truth.label, truth.track_id, boxes["b"][1].track_id) == ("hand", None, 4)
    # the columns of `rotation` are the axes: the box's x is the camera's y here
    np.testing.assert_allclose(truth.box.rotation[:, 0], [0, 1, 0])
    np.testing.assert_allclose(truth.box.center_m, [0, 0, 1])
    np.testing.assert_allclose(truth.box.size_m, [0.2, 0.1, 0.05])


def test_attributes_are_read_and_written(tmp_path: Path):
    values = {"glove": True, "fingers": 5, "length": 0.5, "side": "left"}
    boxes = read_boxes(put(tmp_path, {"a": [UNIT | {"attributes": values}, UNIT]}))
    assert [each.attributes for each in boxes["a"]] == [values, {}]
    write_boxes(tmp_path / "again.json", boxes)
    again = read_boxes(tmp_path / "again.json")["a"]
    assert [(each.attributes, type(each.attributes.get("fingers"))) for each in again] == [
        (values, int),
        ({}, type(None)),
    ]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        pytest.param({"a": {"label": "hand"}}, "a.0.center: Field required", id="missing-key"),
        pytest.param({"a": UNIT | {"size": [1, 0, 1]}}, "frame a, hand: box sizes must be positive", id="flat"),
        pytest.param({"a": UNIT | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "proper rotation", id="mirror"),
        pytest.param({"a": UNIT | {"corners": [[0, 0, 1]] * 8}}, "corners differ by up to", id="other-corners"),
    ],
)
def test_an_invalid_file_is_an_error(tmp_path: Path, content: object, complaint: str):
    path = put(tmp_path, content)
    with pytest.raises(FormatError, match=complaint) as caught:
        read_boxes(path)
    assert str(path) in str(caught.value)


def zipped(path: Path, *names: str, content: bytes = b"Car\n") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, content)
    return path


def test_links_out_of_a_dataset_are_refused(tmp_path: Path) -> None:
    out, secret = tmp_path / "data", tmp_path / "secret.json"
    export("rcv", out, [make_item([make_label()])])
    image, labels = (next((out / name).iterdir()) for name in ("images", "labels"))
    secret.write_bytes(labels.read_bytes())
    for file, target in ((image, secret), (image, Path(image.name)), (labels, secret)):
        kept = file.read_bytes()
        file.unlink()
        file.symlink_to(target)
        with pytest.raises(FormatError, match="leads out of the folder"):
            read_rcv(out).labelled(0)
        file.unlink()
        file.write_bytes(kept)
    assert len(read_rcv(out).labelled(0)[1].truths) == 1


def test_boxes_out_of_range_after_the_transform_to_the_camera_are_errors(tmp_path: Path) -> None:
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", 45, degrees=True))
    label, scene = tmp_path / "label.txt", tmp_path / "index.json"
    label.write_text("bed 1 2 30 40 1e9 1e9 0.3 0.5 1 0.4 0.6 0.8\n")
    polygon = {"X": [1e9 - 1, 1e9, 1e9, 1e9 - 1], "Z": [1e9 - 1, 1e9 - 1, 1e9, 1e9], "Ymin": 0.5, "Ymax": 1.5}
    scene.write_text(json.dumps({"objects": [{"name": "bed", "polygon": [polygon]}]}))
    for path, read in ((label, read_extracted_labels), (scene, read_scene_labels)):
        assert read(path, None)
        with pytest.raises(FormatError, match=r"bed: a box must be within 1e\+09 m") as caught:
            read(path, turned)
        assert caught.value.path == path


def test_long_files_are_not_read_to_the_end(tmp_path: Path) -> None:
    with (tmp_path / "boxes.json").open("wb") as file:
        file.truncate(4 << 30)  # sparse
    with pytest.raises(FormatError, match=r"larger than \d+ MiB"):
        read_boxes(tmp_path / "boxes.json")
    # a few kilobytes that unpack to 20 MiB
    with pytest.raises(FormatError, match=r"labels\.zip/a\.txt: is longer than 16 MiB"):
        list(text_files(zipped(tmp_path / "labels.zip", "a.txt", content=b"\0" * (20 << 20))))


def test_archives_with_hostile_names_write_nothing(tmp_path: Path) -> None:
    path = zipped(tmp_path / "labels.zip", "../../up.txt", "/etc/root.txt", "C:\\x\\windows.txt")
    files = {key: file for key, file, _ in text_files(path)}
    assert sorted(tmp_path.rglob("*")) == [path]
    assert set(files) == {"up", "root", r"C:\x\windows"}
    assert all(file.parent == path for file in files.values())
