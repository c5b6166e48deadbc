"""Each benchmark at a small size; the official evaluators' numbers; real labels through trips of formats."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from nuscenes_samples import real
from test_warm_start import AnyClass

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.detection.trained import TrainingMetrics
from annotator.geometry.iou import iou_3d
from annotator.project import Project, ProjectSettings, WriteContext, create_project, open_project
from annotator.recordings import Recording, open_recording
from annotator.recordings.recording import ReaderOptions
from annotator.synthetic import write_generated
from annotator.types import Box2D, BoxKind, DetectorKind, OrientedBox, Proposal, Quality, Source
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.exporting import ExportFormat
from annotator.workflows.live import detection
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.training.samples import gather
from benchmarks import (
    axes,
    azure_kinect,
    batch,
    cold_start,
    desk,
    follow,
    golden,
    live,
    loop,
    paper,
    paper_protocol,
    ratios,
    step,
    world,
)
from benchmarks.batch import FOLDERS
from benchmarks.report import guarded
from benchmarks.review_moves import Bill
from benchmarks.review_operator import Operator
from benchmarks.trips import FORMATS, LEVELS, NUSCENES, measure

ROOT = Path(__file__).resolve().parents[2]
STRATEGIES = ["camera", "eigenvectors", "normals", "consensus"]
LOOP_KEYS = ["frames", "share_with_proposal", "mask_recall", "mask_precision", "mean_iou", "ap25", "ap50", "boxes_2d"]


def program(name: str, *words: str | Path) -> tuple[dict[str, Any], list[str]]:
    """Runs `python -m benchmarks.NAME`; returns its JSON object and the lines before it."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *map(str, words), "--json"],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    return json.loads(lines[-1]), lines[:-1]


def in_process(module: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> Any:
    """Runs a benchmark in this process; returns its JSON object."""
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words), "--json"])
    module.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 3, "a table comes first"
    return json.loads(lines[-1])


@pytest.fixture
def two_frames(generated: Path, tmp_path: Path) -> Path:
    """The first two frames of the generated people."""
    folder = Path(shutil.copytree(generated / "people", tmp_path / "two"))
    for number in (2, 3, 4):
        for name, suffix in FOLDERS.items():
            (folder / name / f"{number:06d}{suffix}").unlink()
    return folder


def test_axes_compares_all_strategies(
    two_frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(axes, monkeypatch, capsys, two_frames)
    assert result["default_axes"] == "consensus"
    assert [row["axes"] for row in result["results"]] == STRATEGIES
    for row in result["results"]:
        assert (row["label"], row["objects"]) == ("person", 6)
        assert row["false_positives"] == 0, "a perfect detector has no false positives"
    by_axes = {row["axes"]: row["mean_iou"] for row in result["results"]}
    assert by_axes["consensus"] > 0.97
    assert by_axes["consensus"] > max(by_axes[name] for name in STRATEGIES[:-1])


def test_batch_compares_engines(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--frames", 4, "--different", 2, "--width", 160, "--steps", 1, "--engines", "local", "--workers", 1]
    result = in_process(batch, monkeypatch, capsys, *words, "--repeats", 2)
    rows = [(row["engine"], row["workers"]) for row in result["results"]]
    assert rows == [("plain", 0), ("one core", 0), ("local", 1)]
    assert all(row["fps"] > 0 and row["start_s"] > 0 for row in result["results"])
    assert all(result["results"][2][name] > 0 for name in ("against_plain", "against_one_core"))
    assert result["ray_against_local"] is None


def test_store_reports_times() -> None:
    options = ("--frames", "30", "--proposed", "4", "--objects", "2", "--reviewed", "8", "--imported", "60")
    result, lines = program("store", *options)
    assert {"add_recording_ms", "write_proposals_median_ms", "queue_teach_ms", "queue_worst_ms"} <= result.keys()
    assert {"reviewed_statistics_ms", "known_statistics_ms"} <= result.keys()
    assert all(took_ms > 0 for name, took_ms in result.items() if name.endswith("_ms"))
    assert result["open_proposals"] == 30 * 3 + 4 * 2
    assert any("statistics" in line for line in lines)


@pytest.mark.slow
def test_loop_reports_scores_and_times(
    generated: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With real trainings of one epoch."""
    words = [generated / "hands", "--epochs", 1, "--views", 16, "--operator", "silhouette"]
    result = in_process(loop, monkeypatch, capsys, *words)
    assert set(LOOP_KEYS) <= set(result)
    assert result["frames"] == 2
    assert result["boxes_2d"] == 3 * 2 * 5
    assert {"label", "train_image", "train_view", "propose"} <= set(result["seconds"])
    assert all(value is None or 0 <= value <= 1 for key, value in result.items() if key in LOOP_KEYS[1:7])


def test_unusable_input_is_an_error_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["loop", "nowhere"])
    with pytest.raises(SystemExit) as ended:
        guarded(loop.main)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert "Traceback" not in said


@pytest.mark.shared
def test_the_real_azure_kinect_recording_is_within_the_stated_differences(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shared / "data" / "azure_kinect"
    words = [folder / "recording.mkv", folder / "sdk_golden_even.csv"]
    result = in_process(azure_kinect, monkeypatch, capsys, *words)
    assert result["rows"] == 2203
    assert 0 < result["max_point_mm"] < 0.1
    assert 0 < result["max_px"] < 0.05


def test_ratios_above_their_bounds_give_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The times here are simulated."""
    monkeypatch.setattr(
        ratios, "measured", lambda ratio, _: (ratio.work(), ratios.Outcome(ratio.name, 1e9, ratio.most))[1]
    )
    names = [row["name"] for row in ratios.run(ratios.Arguments())["ratios"]]  # type: ignore[attr-defined]
    assert len(names) == 7
    monkeypatch.setattr(sys, "argv", ["ratios", "--json"])
    with pytest.raises(SystemExit) as ended:
        ratios.main()
    assert ended.value.code == 1
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["worse"] == names


def test_all_stages_of_a_step_are_measured_and_each_second_counts_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(step, monkeypatch, capsys, "--points", 2000, "--repeats", 2, "--size-px", 64)
    assert result["points"] == pytest.approx(2000, rel=0.2)
    rows = {(row["path"], row["step"]): row for row in result["steps"]}
    assert list(rows)[:2] == [("plain", "camera"), ("plain", "wide")]
    assert ("warm", "warm") in rows, "the seed was dropped"
    for row in rows.values():
        assert sum(row["share"].values()) == pytest.approx(1)
        assert row["ms"]["render"] > 0 and row["ms"]["cut"] > 0 and row["detector_ms"] > 0
        assert (row["ms"]["check"] > 0) == (row["step"] == "warm")
        assert (row["ms"]["fit"] > 0) == (row["step"] != "camera")
    assert set(result["per_step_ms"]) == {"plain", "warm"}
    assert all(value > 0 for value in result["per_frame_ms"].values())


@pytest.fixture
def agnostic(
    knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Any]:
    """Runs a benchmark in this process with perfect boxes without classes; returns its JSON object."""
    monkeypatch.setattr(cold_start, "load_detector", lambda *_: AnyClass(knowing("people").view))
    monkeypatch.setattr(cold_start, "read_trained", lambda _: SimpleNamespace(image_size_px=96))
    return lambda module, *words: in_process(module, monkeypatch, capsys, *words)


@pytest.mark.parametrize("origin", ["projected", "label"])
def test_cold_start_scores_each_class_beside_clusters(
    agnostic: Callable[..., Any], generated: Path, origin: str
) -> None:
    result = agnostic(cold_start, generated / "people", "--image-box", origin, "--every", 2, "--base", "unused")
    person, clusters = sorted(result["results"], key=lambda row: row["label"])
    assert (person["label"], clusters["label"]) == ("person", "person (clusters)")
    assert (person["taught"], person["objects"]) == (0, clusters["objects"])
    assert person["mean_iou"] > 0.8
    # one of the nine stands behind another
    assert person["recall_50"] >= 8 / 9
    assert 0 < clusters["mean_iou"] < person["mean_iou"]


def test_follow_scores_each_track(agnostic: Callable[..., Any], generated: Path) -> None:
    result = agnostic(follow, generated / "people")
    assert len(result["tracks"]) == 3
    for row in result["tracks"]:
        assert (row["label"], row["frames"]) == ("person", 4)
    assert result["mean_iou"] == pytest.approx(np.mean([row["mean_iou"] for row in result["tracks"]]))
    assert result["mean_iou"] > 0.6
    assert result["silent_errors"] == 0


def test_follow_fits_one_size_to_a_track(agnostic: Callable[..., Any], generated: Path) -> None:
    rows = agnostic(follow, generated / "people", "--sizes", "--base", "unused")["sizes"]
    assert [(row["label"], row["frames"]) for row in rows] == [("person", 5)] * 3
    for row in rows:
        # the detector is right in each frame, and who walks has no one size
        assert row["side_error_m_frame"] < 0.01 < row["side_error_m_track"] < 0.3
        assert 0.75 < row["mean_iou_frame"] > row["mean_iou_track"] > 0.4


def test_objects_that_stand_still_are_right_in_all_later_moments(
    made_once: Callable[[str, Callable[[Path], object]], Path], tmp_path: Path
) -> None:
    tour = made_once("tour", lambda path: write_generated(path / "tour", "tour", 8, 0, 160, 120)) / "tour"
    result = world.still_objects(tour, tmp_path)
    assert result["tracks"] >= 4
    assert result["boxes"] > 2 * result["tracks"]
    assert (result["mean_iou"], result["missed"]) == (pytest.approx(1.0, abs=1e-3), 0.0)


def test_what_stands_still_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def knowing(recording: Recording, seed: int) -> Detectors:
        frames = [recording.frame(n) for n in range(len(recording))]
        scenes = [Scene.of(frame, load_truth(recording, n, frame)) for n, frame in enumerate(frames)]
        both = PerfectDetector(scenes, jitter=0.02, seed=seed, min_points=60)
        return Detectors(both, both)

    monkeypatch.setattr(world, "_detectors", knowing)
    row = world.run(world.Arguments(frames=4, annotated=3, only="tour"))["tour"]
    assert (row["missed"], row["wrong"]) == (0.0, 0)
    kinds = row["by_kind"]["still"]
    assert 4 <= kinds["accept"] <= row["boxes_still"] / 2, "not in each of the four frames"
    assert row["mean_iou"] > 0.75


def test_a_task_at_the_desk_counts_its_actions(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("playwright.sync_api")
    monkeypatch.setattr(desk, "FRAMES", desk.TRACKED + desk.LENGTH)
    result = in_process(desk, monkeypatch, capsys, "--task", "merge_tracks")
    (task,) = result["tasks"].values()
    assert task["actions"] == 2
    assert task["wait_s"] > 0
    assert task["peers"] == {"CVAT": 4, "SUSTechPOINTS": None}


BOUNDS = {"kitti_max_ap": 1e-3, "sunrgbd_max_map": 1e-6, "iou_max_rel": 1e-6, "conventions_max_px": 1e-3}


@pytest.mark.shared
def test_differences_from_the_official_evaluators(shared: Path) -> None:
    """Measured in a separate process, which is faster: in this one, beartype checks all calls."""
    command = [sys.executable, "-m", "benchmarks.golden", str(shared.resolve() / "golden"), "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    measured = json.loads(done.stdout.splitlines()[-1])
    for part, bound in BOUNDS.items():
        assert measured["compared"][part] > 0
        assert measured[part] < bound, f"{part}: {measured[part]} at {measured['worst'][part]}"
    assert measured["compared"]["kitti_max_ap"] == 270, "every number is compared"


@pytest.fixture
def two_parts(shared: Path, tmp_path: Path) -> Path:
    """A folder with two of the parts."""
    names = (golden.SUNRGBD, golden.SUNRGBD_TRUTH, golden.SUNRGBD_FOUND, golden.PAIRS)
    for name in names:
        shutil.copyfile(shared / "golden" / name, tmp_path / name)
    return tmp_path


@pytest.mark.shared
def test_a_wrong_number_is_found_and_named(two_parts: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    path = two_parts / golden.SUNRGBD
    path.write_text(path.read_text().replace("0.25,chair,0.610", "0.25,chair,0.710"))
    monkeypatch.setattr("sys.argv", ["golden", str(two_parts), "--json"])
    golden.main()
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["sunrgbd_max_map"] == pytest.approx(0.1, abs=1e-3)
    assert said["worst"]["sunrgbd_max_map"] == "chair at 0.25"
    assert said["iou_max_rel"] < 1e-6
    assert (said["kitti_max_ap"], said["conventions_max_px"]) == (None, None), "their files are absent"


@pytest.fixture
def trained(tmp_path: Path, knowing: Any, monkeypatch: pytest.MonkeyPatch) -> list[loop.Arguments]:
    """Replaces the training; returns the arguments of each call."""
    asked: list[loop.Arguments] = []

    @contextmanager
    def trained_project(args: loop.Arguments, *_: object) -> Iterator[tuple[Project, int]]:
        asked.append(args)
        settings = ProjectSettings(rcv={"max_steps": 2})
        with create_project(tmp_path, f"loop{len(asked)}", ("hand",), settings=settings) as project:
            yield project, 0

    monkeypatch.setattr(loop, "trained_project", trained_project)
    monkeypatch.setattr(live, "_detectors", lambda project, args: knowing("hands"))
    monkeypatch.setattr(live, "WARM_UP_S", 0.5)
    # on a busy machine, frames are far apart in time
    monkeypatch.setattr(detection, "MAX_SEED_AGE_S", 60.0)
    return asked


def test_it_measures_the_whole_pipeline(
    trained: list[loop.Arguments],
    generated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [generated / "hands", "--project", tmp_path / "kept", "--warm-start", "--seconds", 0.5, "--json"]
    monkeypatch.setattr(sys, "argv", ["live", *map(str, words)])
    live.main()
    lines = capsys.readouterr().out.splitlines()
    result = json.loads(lines[-1])
    assert len(lines) > 3, "a table comes first"
    assert list(result["stages_ms"]) == ["read", "image", "views", "geometry", "show"]
    assert result["shown"] >= live.LEAST_SHOWN
    assert result["fps"] > 0
    assert result["source_fps"] >= live.LEAST_RATE
    assert result["latency_ms"] >= 0.5 * sum(result["stages_ms"].values())
    assert result["latency_p95_ms"] >= result["latency_ms"]
    assert result["objects_per_frame"] == 2
    assert 0 < result["warm_share"] <= 1
    assert (result["warm_start"], result["backend"], result["image_size_px"]) == (True, "fastest", None)
    (asked,) = trained
    assert (asked.train_dir, asked.project) == (generated / "hands", tmp_path / "kept")


QUALITY = 0.7


def moved(box: OrientedBox, along: tuple[float, float, float]) -> OrientedBox:
    """A box shifted along its own axes, metres."""
    return OrientedBox.from_parts(box.center_m + box.rotation @ np.array(along), box.rotation, box.size_m)


def test_wrong_proposals_are_corrected_missing_ones_drawn_others_rejected(generated: Path, tmp_path: Path) -> None:
    room, recording = create_project(tmp_path, "room", ["person"]), open_recording(generated / "people")
    register_recording(room, recording)
    boxes = [[truth.box for truth in load_truth(recording, n, recording.frame(n))] for n in range(len(recording))]
    boxes[0][0] = moved(boxes[0][0], (0.3, 0.0, 0.0))
    missing = boxes[1].pop()
    boxes[2].append(moved(boxes[2][0], (0.0, 0.0, 5.0)))
    for stored, each in zip(room.frames.of(), boxes, strict=True):
        image_box = Box2D("person", 1.0, 2.0, 30.0, 40.0)
        new = [Proposal("person", 0.8, box, image_box, (), Quality(0.1, 0.9, 0.1)) for box in each]
        room.proposals.replace(stored.id, new, WriteContext(stored.revision, "rcv", Source.AUTO))
    operator = Operator(room, room.frames.of(), QUALITY, 2.0, 0)
    operator.review(False)
    left, bill = operator.left(), sum(operator.desk.bills.values(), Bill())
    assert (left.missed, left.wrong) == (0, 0)
    assert bill.actions["reject"] == 1
    assert bill.actions["draw on image"] == 1
    assert sum(bill.actions[kind] for kind in ("drag box", "drag edge", "drag corner", "refit", "draw on view")) >= 1
    drawn = room.labels.of_frame(room.frames.of()[1].id)
    assert max(iou_3d(label.box, missing) for label in drawn) >= QUALITY


# All boxes and values return but those of frames, or all but KITTI's two numbers.
HOLD_FRAMES = {ExportFormat.RCV, ExportFormat.OPENLABEL, ExportFormat.COCO}
KITTI = {ExportFormat.KITTI, ExportFormat.KITTI_TRACKING}


def recording_of(name: str, shared: Path, folder: Path) -> Recording:
    source = shared / "data" / name
    return nuscenes(source, folder) if name == "nuscenes_frame" else open_recording(source)


def nuscenes(source: Path, folder: Path) -> Recording:
    """The real frame with tables of attributes and levels of visibility, as nuScenes has them."""
    real(source, folder)
    tables = folder / "v1.0-mini"
    names = [f"vehicle.{name}" for name in NUSCENES]
    (tables / "attribute.json").write_text(json.dumps([{"token": name, "name": name} for name in names]))
    levels = [{"token": f"{number}", "level": level} for number, level in enumerate(LEVELS, 1)]
    (tables / "visibility.json").write_text(json.dumps(levels))
    rows = json.loads((tables / "sample_annotation.json").read_text())
    for number, row in enumerate(rows):
        row |= {"attribute_tokens": [names[number % 3]], "visibility_token": f"{number % 4 + 1}"}
    (tables / "sample_annotation.json").write_text(json.dumps(rows))
    recording = open_recording(folder, ReaderOptions(camera="CAM_FRONT"))
    read = load_truth(recording, 0, recording.frame(0))
    assert {(each.attributes["vehicle"], each.attributes["visibility"]) for each in read} >= {
        (NUSCENES[number % 3], LEVELS[number % 4]) for number in range(12)
    }
    return recording


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "format", "trips"),
    [
        *[("kitti", format, 2) for format in FORMATS if format is not ExportFormat.KITTI_TRACKING],
        ("kitti", ExportFormat.KITTI, 10),
        ("kitti_drive_0005", ExportFormat.KITTI_TRACKING, 2),
        ("kitti_drive_0005", ExportFormat.OPENLABEL, 10),
        ("nuscenes_frame", ExportFormat.NUSCENES, 2),
        ("nuscenes_frame", ExportFormat.COCO, 2),
        ("sunrgbd/sunrgbd_trainval", ExportFormat.SUSTECHPOINTS, 2),
        ("sunrgbd/sunrgbd_trainval", ExportFormat.COCO, 2),
    ],
)
def test_values_boxes_and_classes_are_equal_after_trips(
    shared: Path, tmp_path: Path, name: str, format: ExportFormat, trips: int
) -> None:
    done = measure(recording_of(name, shared, tmp_path / "set"), tmp_path / "trips", format, trips=trips)
    assert done.is_equal, done
    assert done.values >= 6 * done.boxes > 0
    assert (done.reported > 0) == (format not in HOLD_FRAMES)
    assert done.new == 0 or format in KITTI
    assert done.moved_m < (0.05 if format in KITTI else 1e-9)
    assert done.drifted_m < 1e-9


WIDTH, HEIGHT, FOCAL = 620, 188, 360.0
MIDDLE = np.array([WIDTH, HEIGHT]) / 2
STAGES = ["import", "boxes", "train-image", "train-view", "propose", "evaluate"]
# Height, width, length, metres.
SIZES = {"Pedestrian": (1.8, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8), "Car": (1.5, 1.6, 4.0)}


def write_frame(root: Path, key: str, rng: np.random.Generator) -> None:
    """Upright boxes side by side on the ground, with points on all faces, along the camera's axes."""
    rows, points = [], []
    x = -6.0
    for label in SIZES:
        height, width, length = SIZES[label]
        rotation_y = rng.choice([0.0, np.pi / 2])
        across, along = (length, width) if rotation_y == 0 else (width, length)
        x += across / 2
        size, center = np.array([across, height, along]), np.array([x, 1.6 - height / 2, 13 + rng.uniform(0, 1)])
        x += across / 2 + 0.8
        face = rng.uniform(-0.5, 0.5, (300, 3))
        face[np.arange(300), rng.integers(3, size=300)] = rng.choice([-0.5, 0.5], 300)
        # the corners, so that each side has its full length
        corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
        points.append(np.concatenate([face, corners]) * size * 0.999 + center)
        px = FOCAL * (corners * size + center)[:, :2] / (corners * size + center)[:, 2:]
        left, top = px.min(axis=0) + MIDDLE
        right, bottom = px.max(axis=0) + MIDDLE
        place = f"{left:.2f} {top:.2f} {right:.2f} {bottom:.2f} {height} {width} {length}"
        rows.append(f"{label} 0.00 0 0.00 {place} {center[0]:.4f} 1.6 {center[2]:.4f} {rotation_y:.6f}")
    xyz = np.concatenate(points)
    scan = np.c_[xyz[:, 2], -xyz[:, 0], -xyz[:, 1], np.ones(len(xyz))].astype("<f4")
    P2 = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0]])
    Tr = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    matrices = {"P2": P2, "R0_rect": np.eye(3), "Tr_velo_to_cam": Tr}
    calib = "".join(f"{name}: {' '.join(f'{v:.9e}' for v in m.ravel())}\n" for name, m in matrices.items())
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    (root / "image_2" / f"{key}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (root / "velodyne" / f"{key}.bin").write_bytes(scan.tobytes())
    (root / "calib" / f"{key}.txt").write_text(calib)
    (root / "label_2" / f"{key}.txt").write_text("\n".join(rows) + "\n")


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames: 0 to 3 for training, 4 and 5 for testing, 6 and 7 in neither list."""
    root = tmp_path_factory.mktemp("kitti")
    for folder in ("image_2", "velodyne", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(8):
        write_frame(root / "training", f"{number:06d}", rng)
    (root / "ImageSets").mkdir()
    for side, numbers in (("train", range(4)), ("val", range(4, 6))):
        (root / "ImageSets" / f"{side}.txt").write_text("".join(f"{number:06d}\n" for number in numbers))
    return root


@dataclass
class TrainingStandIn:
    """A stand-in for the training, and a perfect detector for the test frames."""

    trainings: int = 0

    def train(self, project: Project, plan: object, *, roles: tuple[DetectorKind, ...], progress: object) -> list[Any]:
        self.trainings += 1
        material = gather(project, roles)
        assert material.kind is BoxKind.BOX and not material.labels, "trained on other labels than 2D boxes"
        weights = project.models_folder / f"perfect-{roles[0]}.pt"
        weights.write_bytes(b"perfect")
        model = project.models.register(
            roles[0], weights, labels=project.config.classes, box_kind=BoxKind.BOX, metrics={}, fingerprint="perfect"
        )
        pictures = len(material.images) if roles[0] is DetectorKind.IMAGE else len(material.views)
        metrics = TrainingMetrics(map50=1.0, map50_95=1.0, precision=1.0, recall=1.0, measured_on="train")
        result = SimpleNamespace(epochs=1, seconds=0.5, metrics=metrics, note="perfect")
        manifest = SimpleNamespace(images={"train": pictures, "val": 0})
        return [SimpleNamespace(model=model, manifest=manifest, result=result, left_out=())]

    def detectors(self, project: Project) -> Detectors:
        assert {model.role for model in project.models.all()} == set(DetectorKind)
        recording = open_recording(project.recordings.find("val").path)
        frames = [recording.frame(index) for index in range(len(recording))]
        scenes = [
            Scene.of(frame, [t for t in load_truth(recording, index, frame) if t.label in project.config.classes])
            for index, frame in enumerate(frames)
        ]
        perfect = PerfectDetector(scenes)
        return Detectors(perfect, perfect)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> TrainingStandIn:
    training = TrainingStandIn()
    monkeypatch.setattr(paper_protocol, "train", training.train)
    monkeypatch.setattr(paper_protocol, "active_detectors", training.detectors)
    return training


def test_the_kitti_protocol_and_a_repeated_run(
    kitti: Path,
    stand_in: TrainingStandIn,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*words: str) -> tuple[dict[str, Any], list[str]]:
        arguments = ["kitti", "--root", kitti, "--work", tmp_path / "work", "--axes", "camera", *words, "--json"]
        monkeypatch.setattr(sys, "argv", ["paper", *map(str, arguments)])
        paper.main()
        lines = capsys.readouterr().out.splitlines()
        return json.loads(lines[-1]), lines[:-1]

    first, lines = run("--fraction", "0.5")
    assert first["skipped"] == []
    assert list(first["seconds"]) == STAGES
    assert first["stages"]["import"] == {
        "train": 4,
        "val": 2,
        "divided": str(kitti / "ImageSets" / "train.txt"),
        "lists": "6 of 6 listed frames are present",
    }
    boxes = first["stages"]["boxes"]
    assert (boxes["frames"], boxes["objects"]) == (2, {"Pedestrian": 2, "Cyclist": 2, "Car": 2})
    assert (boxes["views"], first["stages"]["train-view"]["pictures"]["train"]) == (24, 24)
    assert first["stages"]["train-image"]["pictures"]["train"] == 2
    assert (first["stages"]["propose"]["frames"], first["stages"]["propose"]["proposals"]) == (2, 6)
    assert set(first["ours"]) == {"Car", "Pedestrian", "Cyclist"}
    for metrics in first["ours"].values():
        assert all(metrics[metric]["R11"][0] > 0 for metric in ("bbox", "bev", "3d"))
    assert "paper, 50%, test set" in "\n".join(lines)
    with open_project(Path(first["project"])) as project:
        train_id = project.recordings.find("train").id
        assert not [x for x in project.labels.select() if project.frames.get(x.frame_id).recording_id == train_id]

    again, _ = run("--fraction", "0.5")
    assert again["skipped"] == STAGES
    assert again == {**first, "skipped": STAGES}
    assert stand_in.trainings == 2
    other, _ = run("--fraction", "0.5", "--axes", "eigenvectors")
    assert other["skipped"] == STAGES[:4]
    little, _ = run("--fraction", "0.5", "--limit", "1")
    assert little["stages"]["import"]["train"] == little["stages"]["import"]["val"] == 1
    assert stand_in.trainings == 4
