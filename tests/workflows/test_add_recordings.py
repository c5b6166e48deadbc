"""Adding recordings, labels and broken frames; the conversions in docs/recordings.md run."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from annotator.project import BoxRotation, NewLabel, Project, WriteContext
from annotator.rcv.config import Orientation
from annotator.recordings import open_recording
from annotator.types import BoxKind, OrientedBox, ReviewState, Source
from annotator.types.errors import BrokenStartError, ConfigError, FormatError, FrameError, ProjectError, RecordingError
from annotator.workflows import add_recordings as adding
from annotator.workflows.add_recordings import add_recordings, bring_back, move_recording
from annotator.workflows.exporting import ExportFormat, export_project
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.importing import Note
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import load_truth


def remove_frame(folder: Path, key: str) -> None:
    (folder / "color" / f"{key}.jpg").unlink()
    (folder / "depth" / f"{key}.png").unlink()


def test_adding_a_recording_again_finds_new_and_missing_frames(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], generated: Path
) -> None:
    folder, project = own_copy("people"), make_project()
    shutil.move(folder / "color" / "000004.jpg", folder / "later.jpg")
    shutil.move(folder / "depth" / "000004.png", folder / "later.png")
    first, other = add_recordings(project, [folder, generated / "hands"])
    assert (first.is_new, first.new_frames, first.recording.name, first.recording.frames) == (True, 4, "people", 4)
    assert other.recording.name == "hands"
    shutil.move(folder / "later.jpg", folder / "color" / "000004.jpg")
    shutil.move(folder / "later.png", folder / "depth" / "000004.png")
    remove_frame(folder, "000000")
    (again,) = add_recordings(project, [folder / ".." / "people"])
    assert (again.is_new, again.new_frames, again.missing_frames) == (False, 1, 1)
    assert (again.recording.id, again.recording.frames) == (first.recording.id, 4)
    assert len(project.recordings.all()) == 2


def test_one_unusable_path_means_that_nothing_is_added(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], generated: Path, tmp_path: Path
) -> None:
    project, broken = make_project(), own_copy("people")
    for path in (broken / "depth").iterdir():
        path.write_bytes(b"")
    for bad, problem in (
        (tmp_path / "nowhere", "no such file or folder"),
        (broken, r"none of its first frames can be read \(5 tried\)"),
    ):
        with pytest.raises(RecordingError, match=problem):
            add_recordings(project, [generated / "hands", bad])
        assert project.recordings.all() == ()


def test_names_and_up_directions_can_be_given(make_project: Callable[..., Project], generated: Path) -> None:
    project = make_project()
    with pytest.raises(ConfigError, match="2 recordings cannot all be called 'x'"):
        add_recordings(project, [generated / "people", generated / "hands"], name="x")
    for name in ("a" * 300, "", " a", "a\nb"):
        with pytest.raises(ConfigError, match="is not a valid name of a recording; use 1 to 100 printable"):
            add_recordings(project, [generated / "people"], name=name)
    with pytest.raises(ProjectError, match="up direction must be"):
        add_recordings(project, [generated / "people"], up=(0.0, 0.0, 0.0))
    (added,) = add_recordings(project, [generated / "people"], name="room", up=(0.0, -2.0, 0.0))
    assert (added.recording.name, added.recording.up) == ("room", (0, -1, 0))


def test_adding_again_with_another_name_or_up_direction_is_an_error(
    make_project: Callable[..., Project], generated: Path
) -> None:
    project = make_project()
    add_recordings(project, [generated / "people"], up=(0.0, -1.0, 0.0))
    add_recordings(project, [generated / "hands"])
    add_recordings(project, [generated / "people"], name="people", up=(0.0, -3.0, 0.0))
    for path, changes, problem in (
        ("people", {"name": "room"}, "is in the project already, as people"),
        ("people", {"up": (0.0, -1.0, -1.0)}, "already, with the up direction"),
        ("people", {"up": (0.0, 0.0, 0.0)}, "already, with the up direction"),
        ("hands", {"up": (0.0, -1.0, 0.0)}, "already, with the up direction that its files give"),
    ):
        with pytest.raises(ConfigError, match=problem):
            add_recordings(project, [generated / path], **changes)
    assert [recording.name for recording in project.recordings.all()] == ["people", "hands"]


def test_a_moved_recording_can_be_given_its_new_path(copied: tuple[Path, Project], tmp_path: Path) -> None:
    folder, project = copied
    (recording,), frame = project.recordings.all(), project.frames.of()[0]
    before = FrameSource(project).read(frame)
    there = tmp_path / "archive" / "take 7"
    there.parent.mkdir()
    shutil.move(folder, there)
    with pytest.raises(RecordingError, match=rf"annotator project move {project.path.name} people PATH"):
        FrameSource(project).read(frame)
    with pytest.raises(RecordingError, match="no known recording format"):
        move_recording(project, recording.id, there.parent)
    moved = move_recording(project, recording.id, there)
    assert (moved.path, moved.name, moved.frames) == (there, "people", 5)
    np.testing.assert_array_equal(FrameSource(project).read(frame).rgb, before.rgb)
    remove_frame(there, "000002")
    with pytest.raises(ProjectError, match="it lacks frame 000002"):
        move_recording(project, recording.id, there)


def test_a_recording_of_another_format_is_not_accepted_as_the_moved_one(people: Project, tmp_path: Path) -> None:
    (recording,) = people.recordings.all()
    kitti = tmp_path / "kitti"
    for name in ("image_2", "velodyne", "calib"):
        (kitti / name).mkdir(parents=True)
    (kitti / "image_2" / "000000.png").touch()
    with pytest.raises(RecordingError, match="of the format kitti_object, but people is of the format rgbd_folder"):
        move_recording(people, recording.id, kitti)


def test_a_recordings_labels_are_imported(people: Project) -> None:
    (recording,) = people.recordings.all()
    told: list[tuple[int, int]] = []
    found = import_own_labels(people, recording.id, lambda done, of: told.append((done, of)))
    assert (found.boxes, found.of(Note.OTHER_CLASS), list(found.of(Note.UNREADABLE))) == ({"person": 15}, {}, [])
    assert told == [(n, 5) for n in range(1, 6)]
    opened = open_recording(recording.path)
    for index, stored in enumerate(people.frames.of()):
        labels = people.labels.of_frame(stored.id)
        truths = load_truth(opened, index, opened.frame(index))
        for label, truth in zip(labels, truths, strict=True):
            assert (label.label, label.track_id) == (truth.label, truth.track_id)
            assert (label.source, label.state, label.score) == (Source.IMPORTED, ReviewState.ACCEPTED, None)
            np.testing.assert_allclose(label.box.size_m, truth.box.size_m)
    # again: all frames have labels now
    assert import_own_labels(people, recording.id).boxes == {}
    assert people.statistics().labels.total == 15


def test_labels_are_imported_while_operators_work(people: Project) -> None:
    """Frames that an operator labels meanwhile are kept; other changes do not prevent the import."""
    frames = people.frames.of()
    theirs = [NewLabel("person", OrientedBox.from_parts(np.array([0.0, 0, 3]), np.eye(3), np.ones(3)))]

    def progress(done: int, of: int) -> None:
        if done == 1:
            people.boxes.set_on_image(frames[2].id, [], BoxKind.BOX, WriteContext(0, "bob"))
            people.labels.create(frames[4].id, theirs, WriteContext(0, "bob"))

    found = import_own_labels(people, 1, progress)
    assert [len(people.labels.of_frame(frame.id)) for frame in frames] == [3, 3, 3, 3, 1]
    assert found.boxes == {"person": 12}


def test_importing_labels_is_retried_after_a_concurrent_change(
    people: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    create, frame = people.labels.create, people.frames.of()[0]

    def late(frame_id: int, *rest: object) -> object:
        if people.frames.get(frame_id).revision == 0:
            people.boxes.set_on_image(frame_id, [], BoxKind.BOX, WriteContext(0, "bob"))
        return create(frame_id, *rest)

    monkeypatch.setattr(type(people.labels), "create", lambda self, *rest: late(*rest))
    assert import_own_labels(people, 1).boxes == {"person": 15}
    assert people.boxes.on_image(frame.id) is not None


def test_an_unreadable_frame_is_reported_and_the_others_are_imported(copied: tuple[Path, Project]) -> None:
    folder, project = copied
    (folder / "depth" / "000004.png").write_bytes(b"")
    told: list[tuple[int, int]] = []
    found = import_own_labels(project, project.recordings.all()[0].id, lambda done, of: told.append((done, of)))
    assert found.boxes == {"person": 12}
    (line,) = list(found.of(Note.UNREADABLE))
    assert line.startswith("000004: ")
    assert "depth/000004.png" in line
    assert told[-1] == (5, 5)


def test_broken_labels_are_an_error(copied: tuple[Path, Project]) -> None:
    folder, project = copied
    file = folder / "truth" / "boxes.json"
    content = json.loads(file.read_text())
    content["000002"][0]["size"] = [0, 1, 1]
    file.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=r"boxes\.json"):
        import_own_labels(project, project.recordings.all()[0].id)


def test_a_broken_label_file_affects_only_its_frame(
    people: Project, make_project: Callable[..., Project], tmp_path: Path
) -> None:
    import_own_labels(people, 1)
    export_project(people, tmp_path / "out", ExportFormat.KITTI)
    broken = sorted((tmp_path / "out").rglob("label_2/*.txt"))[1]
    broken.write_text(broken.read_text().replace("person", "person x", 1))
    project = make_project(tmp_path / "out")
    found = import_own_labels(project, 1)
    assert len(list(found.of(Note.UNREADABLE))) == 1 and f"{broken}:1: " in next(iter(found.of(Note.UNREADABLE)))
    labelled = [bool(project.labels.of_frame(frame.id)) for frame in project.frames.of()]
    assert labelled == [True, False, True, True, True]


def test_frames_are_read_by_key_not_by_index(copied: tuple[Path, Project]) -> None:
    folder, project = copied
    stored = project.frames.of()[3]
    remove_frame(folder, "000000")
    frame = FrameSource(project).read(stored)
    assert (frame.key, frame.index) == ("000003", 2)
    np.testing.assert_array_equal(frame.rgb, open_recording(folder).frame(2).rgb)
    with pytest.raises(FrameError, match="people: frame 000000 no longer exists; restore it, or add the folder"):
        FrameSource(project).read(project.frames.of()[0])


def test_the_projects_up_direction_overrides_the_recordings(
    make_project: Callable[..., Project], generated: Path
) -> None:
    own = open_recording(generated / "people").frame(0).up
    for told, expected in ((None, own), ((3.0, 0.0, -4.0), np.array([0.6, 0.0, -0.8]))):
        project = make_project(generated / "people", up=told)
        np.testing.assert_allclose(FrameSource(project).read(project.frames.of()[0]).up, expected)


@pytest.mark.parametrize(
    ("rotation", "knows_up", "expected"),
    [
        (BoxRotation.AUTO, True, Orientation.UPRIGHT),
        (BoxRotation.AUTO, False, Orientation.FREE),
        (BoxRotation.UPRIGHT, False, Orientation.UPRIGHT),
        (BoxRotation.FREE, True, Orientation.FREE),
    ],
)
def test_the_orientation_follows_from_the_rotation_setting_and_gravity(
    generated: Path, rotation: BoxRotation, knows_up: bool, expected: Orientation
) -> None:
    frame = open_recording(generated / "people").frame(0)
    assert orientation_for(rotation, frame if knows_up else replace(frame, up=None)) is expected


BROKEN = ["000001", "000003", "000004"]
ALWAYS = float("inf")


@pytest.fixture(autouse=True)
def read_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """All frames are read, also on a slow machine."""
    monkeypatch.setattr(adding, "SECONDS", ALWAYS)


@pytest.fixture
def damaged(own_copy: Callable[[str], Path]) -> Path:
    """A recording of five frames: one without depth, one with an empty file, one with a truncated image."""
    folder = own_copy("people")
    (folder / "depth" / "000001.png").unlink()
    (folder / "depth" / "000003.png").write_bytes(b"")
    image = folder / "color" / "000004.jpg"
    image.write_bytes(image.read_bytes()[:-200])
    return folder


def mend(folder: Path, generated: Path, *names: str) -> None:
    for name in names:
        shutil.copy(generated / "people" / name, folder / name)


def present(project: Project) -> dict[str, int]:
    """The indices of the frames that queues, batches and exports see, by key."""
    return {frame.key: frame.index for frame in project.frames.of() if frame.index is not None}


def test_broken_frames_are_told_and_left_out_on_request(
    make_project: Callable[..., Project], damaged: Path, generated: Path
) -> None:
    project = make_project()
    (added,) = add_recordings(project, [damaged])
    assert (list(added.broken.errors), added.left_out, added.recording.frames) == (BROKEN, 0, 5)
    assert present(project) == {f"00000{i}": i for i in range(5)}
    (again,) = add_recordings(project, [damaged], leave_out_broken=True)
    assert (again.left_out, again.new_frames, again.recording.frames) == (3, 0, 2)
    assert present(project) == {"000000": 0, "000002": 2}
    imported = import_own_labels(project, added.recording.id)
    assert (imported.boxes, list(imported.of(Note.UNREADABLE))) == ({"person": 6}, [])
    # a frame that is still broken stays out, and one that can be read comes back
    mend(damaged, generated, "depth/000003.png")
    (mended,) = add_recordings(project, [damaged])
    assert (mended.left_out, list(mended.broken.errors)) == (2, ["000001", "000004"])
    assert present(project) == {"000000": 0, "000002": 2, "000003": 3}


def test_a_new_recording_without_its_broken_frames(
    make_project: Callable[..., Project], damaged: Path, generated: Path, tmp_path: Path
) -> None:
    project = make_project()
    (added,) = add_recordings(project, [damaged], leave_out_broken=True)
    assert (added.left_out, added.new_frames, added.recording.frames) == (3, 2, 2)
    assert present(project) == {"000000": 0, "000002": 2}
    # a moved folder keeps what was left out, as far as it is still broken
    moved = Path(shutil.move(damaged, tmp_path / "moved"))
    mend(moved, generated, "color/000004.jpg")
    move_recording(project, added.recording.id, moved)
    assert present(project) == {"000000": 0, "000002": 2, "000004": 4}
    # a recording that was removed comes back whole
    project.recordings.remove(added.recording.id, "ada")
    bring_back(project, added.recording.id)
    assert present(project) == {f"00000{i}": i for i in range(5)}


def test_frames_are_left_out_even_if_the_first_ones_are_broken(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adding, "FRAMES_TRIED", 4)
    project, folder = make_project(), own_copy("people")
    for number in range(4):
        (folder / "depth" / f"00000{number}.png").write_bytes(b"")
    with pytest.raises(BrokenStartError, match=r"first frames can be read \(4 tried; --leave-out-broken tries all\)"):
        add_recordings(project, [folder])
    add_recordings(project, [folder], leave_out_broken=True)
    assert present(project) == {"000004": 4}
    # from then on, the recording is known by the others
    (again,) = add_recordings(project, [folder])
    assert (again.left_out, again.missing_frames) == (4, 0)
    (folder / "depth" / "000004.png").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"none of its first frames can be read \(5 tried\)"):
        add_recordings(project, [folder], leave_out_broken=True)


PAGE = Path(__file__).resolve().parents[2] / "docs" / "recordings.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
WIDTH, HEIGHT = 40, 30
K = np.array([[50.0, 0, 19.5], [0, 52.0, 14.5], [0, 0, 1]])
RANDOM = np.random.default_rng(0)
RGB = RANDOM.integers(0, 255, (2, HEIGHT, WIDTH, 3)).astype(np.uint8)


@pytest.fixture
def my_loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module that the examples import."""
    module = ModuleType("my_loader")
    monkeypatch.setitem(sys.modules, "my_loader", module)
    monkeypatch.chdir(tmp_path)
    yield module


def run(number: int) -> None:
    assert len([line for line in BLOCKS[number].splitlines() if line and "import" not in line]) <= 12
    exec(compile(BLOCKS[number], f"docs/recordings.md, block {number}", "exec"), {})


def test_images_and_depth_become_an_rgbd_folder(my_loader: ModuleType, tmp_path: Path):
    depth_m = RANDOM.uniform(0.5, 4, (2, HEIGHT, WIDTH))
    my_loader.__dict__.update(K=K, frames=list(zip(RGB, depth_m, (10.0, 10.1), strict=True)))
    run(0)
    recording = open_recording(tmp_path / "recordings/converted")
    frame = recording.frame(1)
    assert (recording.format, len(recording), frame.timestamp_ns) == ("rgbd_folder", 2, 10_100_000_000)
    np.testing.assert_array_equal(frame.rgb, RGB[1])
    np.testing.assert_allclose(frame.depth_m, depth_m[1], atol=6e-4)
    np.testing.assert_array_equal(frame.camera.matrix, K)


def test_scans_with_a_camera_become_a_folder_of_clouds(my_loader: ModuleType, tmp_path: Path):
    xyz, reflectance = RANDOM.uniform((2, -1, -1), (9, 1, 1), (500, 3)), RANDOM.random(500)
    T = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    my_loader.__dict__.update(K=K, T=T, scans=[(rgb, xyz, reflectance) for rgb in RGB])
    run(1)
    recording = open_recording(tmp_path / "recordings/scans")
    cloud = recording.frame(0).cloud
    in_camera = np.c_[xyz, np.ones(500)] @ T[:3].T
    px = in_camera @ K.T
    px = px[:, :2] / px[:, 2:]
    seen = (px >= -0.5).all(axis=1) & (px < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)
    assert (recording.format, len(cloud)) == ("cloud_folder", seen.sum())
    np.testing.assert_allclose(cloud.xyz_m, in_camera[seen], atol=1e-5)
    np.testing.assert_allclose(cloud.reflectance, reflectance[seen], atol=1e-6)
