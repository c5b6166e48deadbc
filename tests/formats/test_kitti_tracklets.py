"""Tracklets of KITTI raw drives: the devkit's corners and frames, and safe parsing of hostile XML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from annotator.formats.kitti_tracklets import read_tracklets
from annotator.geometry.oriented_box import box_corners
from annotator.types.errors import FormatError

HEAD = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
\t<count>{count}</count>
\t<item_version>1</item_version>
"""
TAIL = "</tracklets>\n</boost_serialization>\n"


def pose(tx: float, ty: float, tz: float, rz: float, **more: object) -> str:
    values = {"tx": tx, "ty": ty, "tz": tz, "rx": 0, "ry": 0, "rz": rz, "state": 2, "truncation": 0, **more}
    return (
        "\t\t<item>\n"
        + "".join(f"\t\t\t<{name}>{value}</{name}>\n" for name, value in values.items())
        + "\t\t</item>\n"
    )


def tracklet(label: str, hwl: Sequence[float], first: int, poses: Sequence[str]) -> str:
    h, w, l = hwl  # noqa: E741 - KITTI's own names
    return (
        f'\t<item class_id="1">\n\t\t<objectType>{label}</objectType>\n\t\t<h>{h}</h>\n\t\t<w>{w}</w>\n\t\t<l>{l}</l>\n'
        f"\t\t<first_frame>{first}</first_frame>\n\t\t<poses>\n\t\t<count>{len(poses)}</count>\n"
        f"\t\t<item_version>2</item_version>\n{''.join(poses)}\t\t</poses>\n\t\t<finished>1</finished>\n\t</item>\n"
    )


def document(*tracklets: str) -> str:
    return HEAD.format(count=len(tracklets)) + "".join(tracklets) + TAIL


VAN = tracklet("Van", (2.0, 1.8, 4.5), 3, [pose(10, 2, -1.7, 0.5), pose(11, 2, -1.7, 0.6, truncation=99)])
PEDESTRIAN = tracklet("Pedestrian", (1.7, 0.6, 0.8), 4, [pose(5, -3, -1.6, -2), pose(5, -4, -1.6, -2, truncation=2)])


def written(folder: Path, text: str) -> Path:
    path = folder / "tracklet_labels.xml"
    path.write_text(text)
    return path


def by_devkit(h: float, w: float, l: float, t: Sequence[float], rz: float) -> np.ndarray:  # noqa: E741
    """The corners as in run_demoTracklets.m: x along l, y along w, z from the bottom, rotated about z, translated."""
    x = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * l / 2
    y = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * w / 2
    z = np.array([0, 0, 0, 0, 1, 1, 1, 1]) * h
    turn = np.array([[np.cos(rz), -np.sin(rz), 0], [np.sin(rz), np.cos(rz), 0], [0, 0, 1]])
    return (turn @ np.stack([x, y, z])).T + t


def test_frames_tracks_and_corners_are_those_of_the_devkit(tmp_path: Path):
    frames = read_tracklets(written(tmp_path, document(VAN, PEDESTRIAN)))
    # the pedestrian is outside the image in frame 5; a truncation of 99 means unknown
    assert {number: [(t.label, t.track_id) for t in truths] for number, truths in frames.items()} == {
        3: [("Van", 0)],
        4: [("Van", 0), ("Pedestrian", 1)],
    }
    for truth, expected in (
        (frames[3][0], by_devkit(2.0, 1.8, 4.5, (10, 2, -1.7), 0.5)),
        (frames[4][1], by_devkit(1.7, 0.6, 0.8, (5, -3, -1.6), -2)),
    ):
        found = box_corners(truth.box)
        distance = np.linalg.norm(found[:, None] - expected, axis=2)
        np.testing.assert_allclose(distance.min(axis=1), 0, atol=1e-12)
        np.testing.assert_allclose(distance.min(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(frames[3][0].box.rotation[:, 0], [np.cos(0.5), np.sin(0.5), 0])
    np.testing.assert_allclose(frames[3][0].box.size_m, [4.5, 1.8, 2.0])


BOMB = (
    "<!DOCTYPE a ["
    + "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' if n else '<!ENTITY e1 "ha">' for n in range(10))
    + "]><a>&e10;</a>"
)
BROKEN = [
    ("", r":1: is not valid XML, or truncated"),
    (document(VAN)[:-60], r"is not valid XML, or truncated"),
    ("<a/>", "contains no tracklets"),
    (BOMB, "is not valid XML.*amplification"),
    ('<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "undefined entity"),
    (document(VAN.replace("<l>4.5</l>", "<l>-4.5</l>")), r"object 0: l w h must be positive, not -4\.5"),
    (document(PEDESTRIAN, VAN.replace("<l>4.5</l>", "")), "object 1: l is missing"),
    (document(VAN.replace("<h>2.0</h>", "<h>nan</h>")), "object 0: h: 'nan' is not a finite number"),
    (document(VAN.replace(">Van<", "> <")), "object 0 has no objectType"),
    (document(VAN.replace(">3</first", ">3.5</first")), "first_frame must be a whole number"),
    (document(VAN.replace(">3</first", ">-1</first")), "first_frame must be a whole number"),
    (document(VAN.replace("<tx>11</tx>", "<tx>here</tx>")), "object 0, pose 1: tx: 'here' is not a number"),
    (document(VAN.replace("<ry>0</ry>", "<ry>0.2</ry>", 1)), "object 0, pose 0 has rx or ry"),
    (document(VAN.replace("<tx>10</tx>", "<tx>1e300</tx>")), r"pose 0: a box must be within 1e\+09 m"),
    # unknown, bytes-to-bytes, multi-byte, and one whose decoder raises
    *((document(VAN).replace("UTF-8", name), ":1: declares an encoding") for name in ("TF-8", "hex", "big5", "idna")),
]


@pytest.mark.parametrize(("text", "complaint"), BROKEN)
def test_errors_name_the_file_and_the_object(tmp_path: Path, text: str, complaint: str):
    path = written(tmp_path, text)
    with pytest.raises(FormatError, match=complaint) as caught:
        read_tracklets(path)
    assert str(caught.value).startswith(str(path))
