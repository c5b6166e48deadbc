"""Real labels are exported as they were; KITTI's tracks, unlabelled areas and calibrations go with them."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from annotator.project import Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import OrientedBox
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.add_recordings import add_recordings
from annotator.workflows.exporting import ExportFilter, ExportFormat, Split, export_project
from annotator.workflows.importing import BoxFormat, import_labels, read_labels
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import true_kitti_rows

MakeProject = Callable[..., Project]
CLASSES = ("Car", "Pedestrian", "Cyclist", "Van")
ALL = ExportFilter(empty_frames=True)


def boxes(project: Project) -> dict[str, list[tuple[str, OrientedBox]]]:
    return {f.key: [(x.label, x.box) for x in project.labels.of_frame(f.id)] for f in project.frames.of()}


AREA = "DontCare -1 -1 -10 12.25 20.50 44.75 60.00 -1 -1 -1 -1000 -1000 -1000 -10"


@pytest.fixture
def folder(make_project: MakeProject, generated: Path, tmp_path: Path) -> Path:
    """A KITTI object folder of 5 labelled frames; the second one has a DontCare area."""
    people = make_project(generated / "people")
    import_own_labels(people, people.recordings.all()[0].id)
    export_project(people, tmp_path / "folder", ExportFormat.KITTI, choose=ALL)
    training = tmp_path / "folder" / "training"
    with (training / "label_2" / "000001.txt").open("a") as stream:
        stream.write(f"{AREA}\n")
    return training


def labels_of_export(project: Project, out: Path) -> list[list[str]]:
    export_project(project, out, ExportFormat.KITTI, choose=ALL)
    return [file.read_text().splitlines() for file in sorted((out / "training" / "label_2").iterdir())]


def test_a_partly_labelled_folder_can_be_exported(make_project: MakeProject, folder: Path, tmp_path: Path) -> None:
    (folder / "label_2" / "000003.txt").unlink()
    before = [file.read_text().splitlines() for file in sorted((folder / "label_2").iterdir())]
    project = make_project(folder)
    import_labels(project, read_labels(BoxFormat.KITTI, folder / "label_2"))
    assert labels_of_export(project, tmp_path / "out") == [*before[:3], [], before[3]]


def test_imported_labels_are_shifted_by_the_calibration_beside_them(
    make_project: MakeProject, generated: Path, tmp_path: Path
):
    folder = tmp_path / "training"
    for name in ("label_2", "calib"):
        (folder / name).mkdir(parents=True)
    row = "person 0 0 0 100 100 150 200 1.7 0.5 0.5 1 1.5 8 0\n"
    for stem in ("000000", "000001"):
        (folder / "label_2" / f"{stem}.txt").write_text(row)
    calibration = folder / "calib" / "000000.txt"
    calibration.write_text("P0: 1\nP2: 700 0 600 45 0 700 180 -0.3 0 0 1 0.005\n")
    project = make_project(generated / "people")
    import_labels(project, read_labels(BoxFormat.KITTI, tmp_path))
    (_, first), (_, second) = (boxes(project)[key][0] for key in ("000000", "000001"))
    shift = np.array([(45 - 600 * 0.005) / 700, (-0.3 - 180 * 0.005) / 700, 0.005])
    np.testing.assert_allclose(first.center_m - second.center_m, shift, atol=1e-12)
    (folder / "label_2" / "000000.txt").write_text(row.replace(" 1 1.5 8 ", " 999999999.99 1.5 8 "))
    with pytest.raises(FormatError, match="training: 000000: a box must be within"):
        import_labels(make_project(generated / "people"), read_labels(BoxFormat.KITTI, folder))
    for text, problem in (("P0: 1", "has no P2"), ("P2: 1 0 0 1e9 0 1 0 0 0 0 1 0", "by more than")):
        calibration.write_text(text)
        with pytest.raises(FormatError, match=rf"calib/000000\.txt.*{problem}"):
            read_labels(BoxFormat.KITTI, folder / "label_2")


def derived(row: list[str], P2: np.ndarray, size_px: Sequence[int]) -> np.ndarray:
    """The 2D box of a row by the devkit's formula (golden/kitti_conventions.json), for boxes in front of the camera."""
    h, w, l, x, y, z, ry = map(float, row[8:15])  # noqa: E741
    X = np.array([l, l, -l, -l, l, l, -l, -l]) / 2
    Y = np.array([0, 0, 0, 0, -h, -h, -h, -h])
    Z = np.array([w, -w, -w, w, w, -w, -w, w]) / 2
    c, s = math.cos(ry), math.sin(ry)
    xyz1 = np.stack([c * X + s * Z + x, Y + y, -s * X + c * Z + z, np.ones(8)])
    if xyz1[2].min() < 0.1:
        return np.full(4, np.nan)
    u, v, d = P2 @ xyz1
    px = np.stack([u / d, v / d]).clip(0, np.array([size_px]).T - 1.0)
    return np.array([*px.min(axis=1), *px.max(axis=1)])


@pytest.mark.shared
def test_kittis_labels_are_exported_unchanged(make_project: MakeProject, shared: Path, tmp_path: Path) -> None:
    """2D boxes are derived, 3D numbers are identical, and round trips do not drift."""
    for entry in json.loads((shared / "golden" / "kitti_conventions.json").read_text())["labels"]:
        expected = derived(entry["label"].split(), np.array(entry["P2"]).reshape(3, 4), entry["image_size"])
        if not np.isnan(expected).any():
            np.testing.assert_allclose(expected, entry["expected"]["box_clipped"], atol=1e-4)
    original = root = shared / "data" / "kitti"
    texts: dict[str, str] = {}
    for trip in range(3):
        project = make_project(root, classes=CLASSES)
        import_labels(project, read_labels(BoxFormat.KITTI, root))
        root = tmp_path / f"trip{trip}"
        report = export_project(project, root, ExportFormat.KITTI)
        project.close()
        for file in sorted((root / "training").glob("label_2/*")):
            assert texts.setdefault(file.name, file.read_text()) == file.read_text()
        # the first round trip uses all frames, the others one
        for file in (root / "training").glob("*/*"):
            if file.stem != "000008":
                file.unlink()
    assert not {"tilt", "outside", "lens"} & {loss.kind.value for loss in report.losses}

    compared, levels = 0, list[tuple[int, int]]()
    for name, text in texts.items():
        calib = (original / "training" / "calib" / name).read_text().splitlines()
        P2 = np.array([float(x) for x in calib[2].split()[1:]]).reshape(3, 4)
        with (original / "training" / "image_2" / f"{name[:6]}.png").open("rb") as image:
            size_px = struct.unpack(">16x2I", image.read(24))
        rows = [line.split() for line in (original / "training" / "label_2" / name).read_text().splitlines()]
        for mine, row in zip((line.split() for line in text.splitlines()), rows, strict=True):
            if row[0] == "DontCare":
                assert mine == row
                continue
            assert [mine[0], *mine[8:15]] == [row[0], *row[8:15]]
            assert float(mine[1]) == pytest.approx(float(row[1]), abs=0.0101)
            levels.append((int(row[2]), int(mine[2])))
            expected = derived(row, P2, size_px)
            if not np.isnan(expected).any():
                np.testing.assert_allclose(np.array(mine[4:8], float), expected, atol=0.00501)
                compared += 1
    assert compared >= 70
    known = [(theirs, ours) for theirs, ours in levels if theirs != 3]
    # people have judged KITTI's occlusion levels, ours are measured; 91 % of them agree (docs/formats.md)
    assert np.mean([theirs == ours for theirs, ours in known]) > 0.8
    assert max(abs(theirs - ours) for theirs, ours in known) == 1


@pytest.mark.shared
def test_labels_of_sun_rgbd_are_exported_unchanged(make_project: MakeProject, shared: Path, tmp_path: Path) -> None:
    """VoteNet's numbers of a real frame: the 3D values are unchanged up to the last digit."""
    root = shared / "data" / "sunrgbd" / "sunrgbd_trainval"
    original = (root / "label" / "000001.txt").read_text().splitlines()
    classes = sorted({line.split()[0] for line in original})
    project = make_project(root, classes=classes)
    labels: Path = root
    for trip in range(2):
        import_labels(project, read_labels(BoxFormat.SUNRGBD, labels))
        labels = tmp_path / f"trip{trip}"
        report = export_project(project, labels, ExportFormat.SUNRGBD)
        assert {loss.kind.value for loss in report.losses} == set()
        for mine, theirs in zip((labels / "label" / "000001.txt").read_text().splitlines(), original, strict=True):
            ours, known = mine.split(), theirs.split()
            assert ours[0] == known[0]
            np.testing.assert_allclose(np.array(ours[5:], float), np.array(known[5:], float), atol=1.01e-6)
        project = make_project(root, classes=classes)


TRACKING = ExportFormat.KITTI_TRACKING


def rows(folder: Path, sequence: str) -> list[list[str]]:
    file = folder / "training" / "label_02" / f"{sequence}.txt"
    return [line.split() for line in file.read_text().splitlines()]


def test_a_tracking_export_gives_every_box_a_track_id_and_opens_as_a_recording(
    make_project: MakeProject, generated: Path, tmp_path: Path
) -> None:
    project = make_project(generated / "people", generated / "hands", classes=("person", "hand"))
    for recording in project.recordings.all():
        import_own_labels(project, recording.id)
    # two boxes have lost their track ids
    frame = project.frames.of()[2]
    first, second, _ = project.labels.of_frame(frame.id)
    for label in (first, second):
        context = WriteContext(project.frames.get(frame.id).revision, "ann")
        project.labels.edit(frame.id, label.uid, context, label="person", box=label.box, track_id=None)
    out = tmp_path / "out"
    report = export_project(project, out, TRACKING, choose=ALL)
    assert sorted(path.name for path in (out / "training").iterdir()) == ["calib", "image_02", "label_02", "velodyne"]
    for place in ("image_02", "velodyne"):
        assert [len(list((out / "training" / place / name).iterdir())) for name in ("0000", "0001")] == [5, 5]
    assert report.format == "kitti-tracking"
    assert not {"track"} & {loss.kind.value for loss in report.losses}
    assert report.notes == ("2 boxes without a track id got a new one each; `annotator track` links boxes",)
    found = rows(out, "0000")
    assert all(len(row) == 17 for row in found)
    per_frame = [[int(row[1]) for row in found if row[0] == str(number)] for number in range(5)]
    assert all(len(set(ids)) == len(ids) for ids in per_frame), "track ids are unique in a frame"
    known = {1, 2, 3}
    assert per_frame[0] == [1, 2, 3]
    assert sorted(set(per_frame[2]) - known) == [4, 5]

    # the export is a recording of several scenes, with its labels
    opened = make_project(classes=("person", "hand"))
    added = add_recordings(opened, [out], scenes=["all"])
    assert [(each.recording.name, each.new_frames) for each in added] == [("0000", 5), ("0001", 5)]
    imported = [import_own_labels(opened, each.recording.id) for each in added]
    assert sum(each.boxes.total() for each in imported) == report.objects
    for mine, theirs in zip(project.labels.select(), opened.labels.select(), strict=True):
        np.testing.assert_allclose(theirs.label.box.center_m, mine.label.box.center_m, atol=0.01)
    with pytest.raises(ConfigError, match="a sequence cannot be divided, and people is in several parts"):
        export_project(project, tmp_path / "split", TRACKING, split=Split({"train": 0.5, "val": 0.5}))


def some_frames(drive: Path, folder: Path, numbers: tuple[int, ...]) -> Path:
    """A part of a drive, with links to its files, and without the labels of other frames."""
    for place, suffix in (("image_02", "png"), ("velodyne", "bin")):
        (folder / place).mkdir(parents=True)
        for number in numbers:
            (folder / place / f"{number:06d}.{suffix}").symlink_to(drive / place / f"{number:06d}.{suffix}")
    (folder / "calib.txt").symlink_to(drive / "calib.txt")
    lines = (drive / "label_02.txt").read_text().splitlines(keepends=True)
    (folder / "label_02.txt").write_text("".join(line for line in lines if int(line.split()[0]) in numbers))
    return folder


@pytest.mark.shared
def test_kittis_tracking_labels_are_exported_unchanged(make_project: MakeProject, shared: Path, tmp_path: Path) -> None:
    drive = some_frames(shared / "data" / "kitti_drive_0005", tmp_path / "drive", (2, 3, 4, 9))
    project = make_project(drive, classes=("Van", "Cyclist", "Pedestrian"))
    import_own_labels(project, project.recordings.all()[0].id)
    export_project(project, tmp_path / "out", TRACKING)
    wanted = [line.split() for line in (drive / "label_02.txt").read_text().splitlines()]
    found = rows(tmp_path / "out", "0000")
    key = lambda row: (int(row[0]), int(row[1]), row[2])  # noqa: E731
    areas = [row for row in wanted if row[2] == "DontCare"]
    # detections there are not false positives
    opened, first = open_recording(drive), min(int(row[0]) for row in areas)
    frame = opened.frame([int(key) for key in opened.keys].index(first))
    assert "DontCare" in {row.label for row in true_kitti_rows(opened, frame.index, frame)}
    assert sorted(map(key, found)) == sorted(map(key, wanted))
    assert len(areas) > 3
    pairs = zip(sorted(found, key=key), sorted(wanted, key=key), strict=True)
    # levels of truncation, as KITTI's: a pedestrian enters the image
    assert [a[3] for a in sorted(found, key=key)] == [b[3] for b in sorted(wanted, key=key)]
    assert {row[3] for row in wanted} == {"-1", "0", "1"}
    solid = [(a[10:], b[10:]) for a, b in pairs if a[2] != "DontCare"]
    assert len(solid) == len(wanted) - len(areas) > 6
    np.testing.assert_allclose(
        np.array([a for a, _ in solid], float), np.array([b for _, b in solid], float), atol=0.00501
    )
    # the drive's labels, read as a sequence folder, are the same
    folder = tmp_path / "official" / "label_02"
    folder.mkdir(parents=True)
    (folder / "0000.txt").write_bytes((drive / "label_02.txt").read_bytes())
    other = make_project(drive, classes=("Van", "Cyclist", "Pedestrian"))
    assert sum(import_labels(other, read_labels(BoxFormat.KITTI_TRACKING, folder.parent)).boxes.values()) == len(solid)
    ids = {stored.label.track_id for stored in other.labels.select()}
    assert ids == {int(row[1]) for row in wanted} - {-1}
    assert open_recording(drive).format == "kitti_tracking"
