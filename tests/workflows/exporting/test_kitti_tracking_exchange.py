"""KITTI tracking folders: export with track ids, and import."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from annotator.formats.kitti.tracking_folder import sequence_ids
from annotator.project import Project, WriteContext
from annotator.recordings import ReaderOptions, open_recording
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.add_recordings import add_recordings
from annotator.workflows.exporting import ExportFilter, ExportFormat, Split, export_project
from annotator.workflows.importing import BoxFormat, Note, import_labels, read_labels
from annotator.workflows.recorded.own_labels import import_own_labels

MakeProject = Callable[..., Project]
TRACKING = ExportFormat.KITTI_TRACKING
ALL = ExportFilter(empty_frames=True)


def rows(folder: Path, sequence: str) -> list[list[str]]:
    file = folder / "training" / "label_02" / f"{sequence}.txt"
    return [line.split() for line in file.read_text().splitlines()]


@pytest.mark.usefixtures("older_tracks")
def test_a_tracking_export_can_be_imported_with_its_track_ids(
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

    other = make_project(generated / "people", generated / "hands", classes=("person", "hand"))
    done = import_labels(other, read_labels(BoxFormat.KITTI_TRACKING, out))
    assert (done.frames, sum(done.boxes.values()), tuple(done.of(Note.UNMATCHED))) == (10, report.objects, ())
    for mine, theirs in zip(project.frames.of(), other.frames.of(), strict=True):
        if mine.id != frame.id:
            wanted = [label.track_id for label in project.labels.of_frame(mine.id)]
            read = [label.track_id for label in other.labels.of_frame(theirs.id)]
            assert read == [number for number in wanted if number in read]
    again = export_project(other, tmp_path / "again", TRACKING, choose=ALL)
    assert again.notes == ()
    assert rows(tmp_path / "again", "0000") == found

    # the export is a recording of several scenes, with its labels
    opened = make_project(classes=("person", "hand"))
    added = add_recordings(opened, [out], scenes=["all"])
    assert [(each.recording.name, each.new_frames) for each in added] == [("0000", 5), ("0001", 5)]
    imported = [import_own_labels(opened, each.recording.id) for each in added]
    assert sum(each.boxes.total() for each in imported) == report.objects
    for mine, theirs in zip(project.labels.select(), opened.labels.select(), strict=True):
        np.testing.assert_allclose(theirs.label.box.center_m, mine.label.box.center_m, atol=0.01)
    with pytest.raises(ConfigError, match="has no scene 7; it has 0000, 0001"):
        open_recording(out, ReaderOptions(scene="7"))
    assert open_recording(out).notes == ("2 drives: 0000, 0001; this is the first (--scene names another, or all)",)

    with pytest.raises(ConfigError, match="a sequence cannot be divided, and people is in several parts"):
        export_project(project, tmp_path / "split", TRACKING, split=Split({"train": 0.5, "val": 0.5}))
    (out / "training" / "label_02" / "0001.txt").write_text("0 1 hand 0 0\n")
    with pytest.raises(FormatError, match=r"0001\.txt:1: a tracking row has 17 fields, not 5"):
        read_labels(BoxFormat.KITTI_TRACKING, out)


def test_sequences_keep_frame_numbers() -> None:
    places = [("b", "000007", 0), ("b", "000009", 1), ("a", "x", 0), ("a", "y", 4)]
    assert list(sequence_ids(places).values()) == [("0000", 7), ("0000", 9), ("0001", 0), ("0001", 4)]


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
