"""Generated recordings and pictures: exact truth, equal bytes for equal seeds."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.box_files import read_boxes
from annotator.formats.reading import read_mask
from annotator.geometry.oriented_box import contains
from annotator.recordings import open_recording
from annotator.recordings.poses import survey_poses
from annotator.recordings.recording import ReaderOptions
from annotator.synthetic import write_generated
from annotator.synthetic.arrangements import Actor
from annotator.synthetic.materials import Lights, Material, Palette
from annotator.synthetic.mesh import Mesh, Parts, box_mesh, joined
from annotator.synthetic.people import pacing
from annotator.synthetic.render import Rendering, Sensor, depth_image, render, whole_px
from annotator.synthetic.snapshots import MIN_POINTS, Snapshot, snapshot
from annotator.synthetic.writer import drifting
from annotator.types import Camera
from annotator.types.errors import AnnotatorError
from annotator.workflows.recorded.reading import load_truth

PRESETS = ("people", "hands", "objects")
FRAMES = 3
SIZE = {"width": 192, "height": 144}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="session")
def generated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One small recording of each preset."""
    root = tmp_path_factory.mktemp("generated")
    for preset in PRESETS:
        write_generated(root / preset, preset, FRAMES, seed=5, **SIZE)
    return {preset: root / preset for preset in PRESETS}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_generated_recording_is_an_rgbd_folder_with_gravity(generated: dict[str, Path], preset: str):
    recording = open_recording(generated[preset])
    assert (recording.format, len(recording), recording.is_sequence) == ("rgbd_folder", FRAMES, True)
    frame = recording.frame(FRAMES - 1)
    assert frame.rgb.shape == (144, 192, 3)
    assert frame.up is not None
    assert frame.up @ [0, -1, 0] > (0.2 if preset == "objects" else 0.9)  # the camera is almost upright, or looks down
    made = json.loads((generated[preset] / "generated.json").read_text())
    assert made == {"version": 3, "preset": preset, "seed": 5, "frames": FRAMES, "period_s": 0.1}


@pytest.mark.parametrize("preset", PRESETS)
def test_the_truth_is_in_a_separate_folder_and_fits_the_measured_points(generated: dict[str, Path], preset: str):
    folder = generated[preset]
    assert not (folder / "boxes.json").exists()
    assert not (folder / "mask").exists()
    recording, boxes = open_recording(folder), read_boxes(folder / "truth" / "boxes.json")
    assert tuple(boxes) == recording.keys
    for i, key in enumerate(recording.keys):
        frame, mask = recording.frame(i), read_mask(folder / "truth" / "mask" / f"{key}.png")
        assert boxes[key]
        assert set(np.unique(mask)) == set(range(len(boxes[key]) + 1))
        assert len({truth.track_id for truth in boxes[key]}) == len(boxes[key])
        numbers = mask.ravel()[frame.cloud.pixel_index]
        for number, truth in enumerate(boxes[key], start=1):
            assert truth.label == {"people": "person", "hands": "hand", "objects": "object"}[preset]
            points = frame.cloud.xyz_m[numbers == number]
            assert len(points) > 20
            # all except noise at the far side of the people
            assert contains(truth.box, points, 0.03).mean() > 0.98
            if preset == "objects":  # they may touch, and are hollow
                continue
            # few other points are in the box: arms end at the wrist, and people keep a distance
            assert contains(truth.box, points).sum() > 0.5 * contains(truth.box, frame.cloud.xyz_m).sum()


def test_equal_seeds_give_equal_bytes_and_other_seeds_do_not(generated: dict[str, Path], tmp_path: Path):
    write_generated(tmp_path / "again", "people", FRAMES, seed=5, **SIZE)
    assert contents(tmp_path / "again") == contents(generated["people"])
    write_generated(tmp_path / "other", "people", 1, seed=4, **SIZE)
    one, other = (contents(folder)["color/000000.jpg"] for folder in (tmp_path / "again", tmp_path / "other"))
    assert one != other


def test_the_objects_of_a_tour_stand_still_by_its_poses_and_people_walk(tmp_path: Path):
    write_generated(tmp_path / "a", "tour", 8, seed=2, **SIZE)
    recording, boxes = open_recording(tmp_path / "a"), read_boxes(tmp_path / "a" / "truth" / "boxes.json")
    report = survey_poses(recording)
    assert report is not None
    assert (report.posed, report.gaps, report.jumps, recording.pose_source) == (8, (), (), "poses.csv")
    assert (tmp_path / "a" / "poses.csv").read_bytes() == (tmp_path / "a" / "truth" / "poses.csv").read_bytes()
    places: dict[str, dict[int, list[np.ndarray]]] = {"object": {}, "person": {}}
    for i, key in enumerate(recording.keys):
        pose, frame = recording.pose(i), recording.frame(i)
        assert pose is not None
        np.testing.assert_allclose(pose.rotation.apply(frame.up), [0, 0, 1], atol=1e-6)  # type: ignore[arg-type]
        for truth in boxes[key]:
            assert truth.track_id is not None
            places[truth.label].setdefault(truth.track_id, []).append(pose.apply(truth.box.center_m))
    ways = {label: [np.ptp(each, axis=0).max() for each in tracks.values()] for label, tracks in places.items()}
    assert len(ways["object"]) >= 6 and max(ways["object"]) < 1e-6
    assert max(ways["person"]) > 0.2


def test_the_parked_cars_of_a_drive_stand_still_by_its_poses_and_the_others_move(tmp_path: Path):
    write_generated(tmp_path / "a", "drive", 3, seed=2, drift=0.01)
    exact = (tmp_path / "a" / "truth" / "poses.csv").read_bytes()
    assert (tmp_path / "a" / "poses.csv").read_bytes() != exact
    (tmp_path / "a" / "poses.csv").write_bytes(exact)
    recording = open_recording(tmp_path / "a")
    assert (recording.format, recording.pose_source) == ("cloud_folder", "poses.csv")
    assert recording.times_ns == (100_000_000, 200_000_000, 300_000_000)
    places = dict[tuple[str, int | None], list[np.ndarray]]()
    for i in range(3):
        frame, T_world_camera = recording.frame(i), recording.pose(i)
        assert T_world_camera is not None
        for truth in load_truth(recording, i, frame):
            # the points are on the object, up to the noise of the distance
            assert contains(truth.box, frame.cloud.xyz_m, 0.05).sum() >= 10
            places.setdefault((truth.label, truth.track_id), []).append(T_world_camera.apply(truth.box.center_m))
    # about half of them are before the virtual camera
    all_boxes = [truth for truths in read_boxes(tmp_path / "a" / "truth" / "boxes.json").values() for truth in truths]
    assert sum(map(len, places.values())) < len(all_boxes)
    assert len({truth.track_id for truth in all_boxes if truth.label == "car"}) > 12
    moved = {name: float(np.linalg.norm(each[-1] - each[0])) for name, each in places.items() if len(each) == 3}
    parked = [way for (label, track), way in moved.items() if label == "car" and track <= 20]  # type: ignore[operator]
    assert len(parked) > 5 and max(parked) < 1e-4
    assert min(way for (_, track), way in moved.items() if track > 20) > 0.15  # type: ignore[operator]
    around = open_recording(tmp_path / "a", ReaderOptions(look_around=4, camera="around-090"))
    assert load_truth(around, 0, around.frame(0))
    pose, left = recording.pose(0), around.pose(0)
    assert pose is not None and left is not None
    np.testing.assert_allclose(pose.rotation.as_matrix()[:, 0], -left.rotation.as_matrix()[:, 2], atol=1e-7)


def test_poses_drift_by_a_share_of_the_way(tmp_path: Path):
    """A step is 2 % too long, and each metre turns what follows by 1 % of a radian."""
    turn = Rotation.from_euler("z", 90, degrees=True)
    exact = [RigidTransform.from_components([x, 0, 1], turn) for x in (0.0, 1.0, 3.0)]
    found = drifting(exact, 0.02)
    places = [(0, 0, 1), (1.02, 0, 1), (1.02 + 2.04 * np.cos(0.01), 2.04 * np.sin(0.01), 1)]
    for pose, place, angle in zip(found, places, (0, 0.01, 0.03), strict=True):
        np.testing.assert_allclose(pose.translation, place, atol=1e-9)
        assert (turn.inv() * pose.rotation).magnitude() == pytest.approx(angle)
    write_generated(tmp_path / "a", "tour", 3, 2, 32, 24, drift=0.1)
    drifted, true = ((tmp_path / "a" / name).read_text().splitlines() for name in ("poses.csv", "truth/poses.csv"))
    assert drifted[:2] == true[:2] and drifted[2:] != true[2:]
    assert json.loads((tmp_path / "a" / "generated.json").read_text())["drift"] == 0.1


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path):
    def interrupt(done: int, frames: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_generated(tmp_path / "r", "hands", 5, 0, 32, 24, report=interrupt)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"preset": "cats"}, "unknown preset 'cats'; choose one of people, hands, objects, tour, drive"),
        ({"drift": 0.1}, "the camera of hands stands still"),
        ({"drift": 2.0, "preset": "tour"}, r"a share of the way, 0 to 0\.2, not 2"),
        ({"frames": 0}, "frames must be at least 1"),
        ({"seed": -1}, "the seed must be 0 or more"),
        ({"path": "n" * 250}, r"cannot be created \(File name too long"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path: Path, change: dict[str, object], complaint: str):
    arguments: dict[str, object] = {"path": "new", "preset": "hands", "frames": 1, "seed": 0} | change
    arguments["path"] = tmp_path / str(arguments["path"])
    with pytest.raises(AnnotatorError, match=complaint):
        write_generated(**arguments)
    assert list(tmp_path.iterdir()) == []


CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
LEVEL = RigidTransform.identity()  # the camera frame is the world frame
RED, WHITE = Material((0.8, 0.1, 0.1), grain=0.0), Material((0.9, 0.9, 0.9), grain=0.0)
LIGHTS = Lights((0.0, -3.0, 1.0))


def palette() -> Palette:
    made = Palette()
    for material in (RED, WHITE):
        made.add(material)
    return made


def ball(
    center: tuple[float | int, float | int, float | int], radius: float, track: int = 1, power: float = 2.0
) -> Mesh:
    blobs = Parts()
    blobs.ball(np.array(center, float), (radius, radius, radius), 0, power=power)
    return blobs.mesh().tracked(track)


WALL = box_mesh((0, 0, 3.5), (20, 20, 1), 1)


def rendered(mesh: Mesh) -> Rendering:
    """A mesh in front of the wall."""
    return render(CAMERA, LEVEL, joined([WALL, mesh]), palette(), LIGHTS)


def test_the_depth_agrees_with_the_plane_and_the_sphere():
    rendering = rendered(ball((0, 0, 2.0), 0.5))
    seen = rendering.track == 1
    np.testing.assert_allclose(rendering.depth_m[~seen], 3.0, atol=1e-5)
    # a ray meets the sphere |x - c| = r at the smaller root
    v, u = np.nonzero(seen)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], axis=1)
    square, middle = (rays**2).sum(axis=1), rays[:, 2] * 2.0
    root = np.maximum(middle**2 - square * (4 - 0.25), 0)
    exact = (middle - np.sqrt(root)) / square
    assert np.median(np.abs(rendering.depth_m[seen] - exact)) < 0.01  # the mesh has flat facets
    outline = np.hypot(v - CAMERA.cy, u - CAMERA.cx).max()
    assert outline == pytest.approx(80 * 0.5 / np.sqrt(4 - 0.25), abs=1.0)


def test_an_actors_box_touches_its_surface_on_all_six_sides():
    axes = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]).as_matrix()
    mesh = joined([ball((0.2, 0.1, 2.0), 0.3, power=4), ball((-0.3, 0.2, 2.4), 0.2)])
    T_camera_world = RigidTransform.from_components([0.1, -0.2, 0.3], Rotation.from_euler("y", 0.4))
    box = Actor(1, "thing", mesh, axes).box(T_camera_world)
    in_camera = T_camera_world.apply(mesh.vertices.astype(np.float64))
    assert contains(box, in_camera, 1e-6).all()
    local = box.T_camera_box.inv().apply(in_camera)
    np.testing.assert_allclose(local.max(axis=0), box.size_m / 2, atol=1e-6)
    np.testing.assert_allclose(local.min(axis=0), -box.size_m / 2, atol=1e-6)
    np.testing.assert_allclose(box.rotation, T_camera_world.rotation.as_matrix() @ axes, atol=1e-9)


@settings(deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(-0.25, 0.25), st.floats(1.5, 2.2), st.floats(0.1, 0.3))
def test_the_whole_of_an_object_counts_what_is_hidden_and_what_is_outside(x: float, y: float, z: float, radius: float):
    mesh = ball((x, y, z), radius, power=3)
    seen = int((rendered(mesh).track == 1).sum())
    assert whole_px(CAMERA, LEVEL, mesh) == seen
    aside = ball((CAMERA.cx / CAMERA.fx * z, y, z), radius, power=3)  # half of it is beyond the image's border
    assert whole_px(CAMERA, LEVEL, aside) == pytest.approx(2 * (rendered(aside).track == 1).sum(), rel=0.25, abs=12)


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_the_depth_noise_grows_with_the_square_of_the_distance(z: float):
    sensor = Sensor()
    ones = np.ones((200, 200), np.float32)
    plane = Rendering(np.zeros((200, 200, 3), np.uint8), z * ones, np.zeros((200, 200), np.int16), ones)
    measured = depth_image(plane, sensor, np.random.default_rng(0)).astype(float) / 1000
    valid = measured > 0
    assert 1 - valid.mean() == pytest.approx(sensor.dropout, abs=0.003)
    assert measured[valid].mean() == pytest.approx(z, abs=2e-4)
    assert measured[valid].std() == pytest.approx(0.0008 + 0.0009 * z**2, rel=0.1)


def test_people_pace_steadily_within_reach():
    walkers = list(islice(pacing(0.3, 3.0, 1.2, np.random.default_rng(5)), 300))
    places = np.array([walker.place for walker in walkers])
    assert np.ptp(places[:, 0]) > 1.0
    assert np.abs(places[:, 0]).max() < 1.3
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.25, "2.5 m/s"
    assert np.abs(np.diff([walker.yaw for walker in walkers])).max() < 0.27


SEEDS = range(12)


@pytest.fixture(scope="module")
def snapshots() -> list[Snapshot]:
    return [snapshot(seed) for seed in SEEDS]


def test_the_boxes_hold_their_measured_points(snapshots: list[Snapshot]) -> None:
    objects = [(shot, item) for shot in snapshots for item in shot.objects]
    assert len(objects) > 2 * len(SEEDS)
    for shot, item in objects:
        assert item.points.sum() >= MIN_POINTS
        # the noise of a far depth measurement is the largest error
        distance_m = float(np.linalg.norm(item.box.center_m))
        margin_m = 0.05 + 0.01 * distance_m**2 if shot.frame.depth_m is not None else 0.15
        assert contains(item.box, shot.frame.cloud.xyz_m[item.points], margin_m).mean() > 0.95


def test_snapshots_come_from_depth_cameras_and_from_lidars(snapshots: list[Snapshot]) -> None:
    lidars = [shot for shot in snapshots if shot.frame.depth_m is None]
    assert 0 < len(lidars) < len(snapshots)
    for shot in snapshots:
        cloud = shot.frame.cloud
        assert (cloud.pixel_index is None) == (shot.frame.depth_m is None)
        assert np.linalg.norm(shot.frame.up) == pytest.approx(1)
    assert max(shot.frame.cloud.xyz_m[:, 2].max() for shot in lidars) > 20


def test_equal_seeds_give_equal_frames_and_other_versions_do_not(snapshots: list[Snapshot]) -> None:
    for seed in (0, 1, 2):
        again, other = snapshot(seed), snapshot(seed, version=2)
        assert np.array_equal(again.frame.cloud.xyz_m, snapshots[seed].frame.cloud.xyz_m)
        assert not np.array_equal(other.frame.cloud.xyz_m, snapshots[seed].frame.cloud.xyz_m)
