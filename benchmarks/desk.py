"""Everyday tasks in Annotate, done in Chromium with a mouse and keys: how many actions they take, and the waiting.

    python -m benchmarks.desk [--task NAME] [--json]

An action is a click, a drag or a key, also with Ctrl or Shift; a word that is typed into a field is one, and the Enter
after it another. To wait is to wait for what an action asks for. A task counts only if the server has stored what it
should lead to. Everything is generated: people in a room, and a scan of a street that four virtual cameras see. Each
task begins with the frame open and its box selected, if it has one, and with the view as it is at first.

`peers` are the same counts of other tools by what they publish about themselves: for the first box as the tool gives
it, with the object's frame open; null where that does not say how it is done.
"""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.project import BoxRotation, NewLabel, Project, ProjectSettings, WriteContext, create_project
from annotator.recordings import ReaderOptions, open_recording
from annotator.synthetic import write_generated
from annotator.synthetic.materials import Lights, Material, Palette
from annotator.synthetic.mesh import box_mesh, joined
from annotator.synthetic.render import Lidar, scan
from annotator.types import Camera, OrientedBox, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import ALL, add_recordings
from annotator.workflows.recorded.reading import load_truth
from benchmarks import workbench
from benchmarks.report import QUIET, Options, Table, chosen, guarded, program
from benchmarks.served import (
    PRESET,
    Server,
    answered,
    chromium,
    drag,
    on_page,
    open_frame,
    serving,
    signed_in,
    until,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator

Point = tuple[float, float]
FRAMES, GONE_TO = 100, 17
# Boxes of a session, every fifth of which is changed in all ways.
SESSION, CHANGED = 50, 5
# Frames of the room, by what is prepared in them; a track of 25 frames begins in the last one.
PROPOSED, FACE, TURNED, TRACKED = 40, 41, 43, 50
LENGTH, MIDDLE = 25, 12
ROOM, DRIVE, CLASSES, VEHICLES = "room", "drive", ("person", "dummy"), ("Car", "Truck", "Pedestrian")
# On the street, x ahead, y to the left, on the ground: place, size and heading; the far car is only thought of.
STREET = {
    "Truck": ((10.7, 9.0), (8.0, 2.5, 3.2), 130.0),
    "Pedestrian": ((9.0, -3.0), (0.6, 0.7, 1.75), 0.0),
    "Car": ((18.0, -7.0), (4.3, 1.8, 1.5), 80.0),
}
FAR, EYE_M = (42.0, 6.0), 1.8
RIGHT, EXACT_M, NEAR_M = 0.5, 0.05, 1.5
AT_REST = "!document.querySelector('.annotate[data-saving]')"
PATIENCE_S = 60.0


@dataclass
class Arguments(Options):
    task: str | None = None
    """Name of the only task to do; by default all, and what the page makes wait for."""


class Hand:
    """The operator's mouse and keys, with a count of what they do. `client` prepares and checks without them."""

    def __init__(self, browser: Browser, server: Server, room: Room, drive: Drive) -> None:
        self._browser, self._server, self.client = browser, server, server.client("Ada")
        self.page = signed_in(browser, server)
        self.room, self.drive = room, drive
        self.actions, self.wait_s = 0, 0.0

    def open(self, project: str, frame: int, uid: str = "") -> None:
        """Opens a frame as one finds it, and begins to count."""
        self.page.context.close()
        self.page = signed_in(self._browser, self._server)
        open_frame(self.page, project, frame, uid)
        if uid:
            until(self.page, f"document.querySelector('[data-testid=orthos]')?.dataset.shown === '{uid}'", PATIENCE_S)
        self.actions, self.wait_s = 0, 0.0

    def get(self, name: str) -> Locator:
        return self.page.get_by_test_id(name)

    def press(self, key: str, done: str | Callable[[], bool]) -> None:
        self.page.keyboard.press(key)
        self._acted(done)

    def type(self, word: str) -> None:
        self.page.keyboard.type(word)
        self._acted("true")

    def click(self, where: Locator | Point, done: str | Callable[[], bool]) -> None:
        if isinstance(where, tuple):
            self.page.mouse.click(*where)
        else:
            where.click()
        self._acted(done)

    def drag(self, start: Point, end: Point, done: str | Callable[[], bool]) -> None:
        drag(self.page, start, end)
        self._acted(done)

    def draw(self, box: tuple[float, float, float, float], key: str = "") -> None:
        """Drags a box on the image (its edges in pixels of the image), with the key of its class during the drag, and
        waits for the dashed 3D box.
        """
        self.actions += bool(key)
        drag(self.page, on_page(self.page, *box[:2]), on_page(self.page, *box[2:]), key)
        self._acted("document.querySelector('[data-testid=label-state]')?.textContent === 'new'")

    def _acted(self, done: str | Callable[[], bool]) -> None:
        """Waits until what was asked for is there: an expression of the page, or of what the server has."""
        self.actions += 1
        begin = time.perf_counter()
        if isinstance(done, str):
            self.page.wait_for_function(f"() => {AT_REST} && {done}", timeout=1000 * PATIENCE_S)
        else:
            while not done():
                if time.perf_counter() - begin > PATIENCE_S:
                    raise ConfigError("the result of the last action is not what it should be")
                self.page.wait_for_timeout(20)
        self.wait_s += time.perf_counter() - begin

    # -- what the server has

    def state(self, project: str, frame: int) -> dict[str, Any]:
        return dict(answered(self.client.get(f"/api/projects/{project}/frames/{frame}")))

    @property
    def shown(self) -> dict[str, Any]:
        """The frame that the page shows."""
        project, _, frame = self.page.url.split("#/")[1].split("?")[0].split("/")
        return dict(self.state(project, int(frame))["frame"])

    def labels(self, project: str, frame: int) -> list[dict[str, Any]]:
        return [each for each in self.state(project, frame)["labels"] if each["state"] in ("accepted", "edited")]

    def has(self, project: str, frame: int, label: str, truth: OrientedBox) -> bool:
        """Whether a reviewed box of a class is right."""
        found = [boxed(each) for each in self.labels(project, frame) if each["label"] == label]
        return any(iou_3d(box, truth) >= RIGHT for box in found)

    def is_exact(self, project: str, frame: int, truth: OrientedBox) -> bool:
        """Whether the frame's only reviewed box has its corners where the true one's are, with its heading."""
        (label,) = self.labels(project, frame)
        box = boxed(label)
        ends = [each.center_m + each.rotation @ (side * each.size_m / 2) for each in (box, truth) for side in (-1, 1)]
        return bool(np.abs(np.array(ends[:2]) - ends[2:]).max() < EXACT_M)

    def track(self, number: int) -> dict[int, str]:
        """The frames of a track of the room, with their uids."""
        path = f"/api/projects/{ROOM}/recordings/1/tracks/{number}"
        return {each["frame"]: each["uid"] for each in answered(self.client.get(path))}


def boxed(label: dict[str, Any]) -> OrientedBox:
    box = label["box"]
    return OrientedBox.from_parts(np.array(box["center"]), np.array(box["rotation"]), np.array(box["size"]))


# -- the recordings, and what is labelled in them before


@dataclass(frozen=True)
class Room:
    """People in a room: the ids of the frames, the true boxes in each, and the camera."""

    frames: list[int]
    truths: list[list[OrientedBox]]
    camera: Camera
    uids: dict[str, str]


@dataclass(frozen=True)
class Drive:
    """A street seen by four virtual cameras: their frames at two moments, and the true boxes as the first sees them."""

    frames: list[list[int]]
    truths: dict[str, OrientedBox]
    camera: Camera
    moved: str


def room(folder: Path, projects: Path) -> Room:
    for name, frames, seed in ((PRESET, FRAMES, 0), ("others", 2, 1)):
        write_generated(folder / name, PRESET, frames, seed, 320, 240)
    recording = open_recording(folder / PRESET)
    read = [recording.frame(index) for index in range(FRAMES)]
    truths = [load_truth(recording, index, frame) for index, frame in enumerate(read)]
    boxes = [[truth.box for truth in each] for each in truths]
    with create_project(projects, ROOM, CLASSES, settings=ProjectSettings(rotation=BoxRotation.UPRIGHT)) as project:
        add_recordings(project, [folder / PRESET, folder / "others"])
        ids = [frame.id for frame in project.frames.of([1])]
        first = boxes[FACE][0]
        # a third of its length is missing in front
        cut = np.array([first.size_m[0] / 3, 0.0, 0.0])
        short = OrientedBox.from_parts(first.center_m - first.rotation @ cut / 2, first.rotation, first.size_m - cut)
        back = boxes[TURNED][0]
        turned = OrientedBox.from_parts(back.center_m, back.rotation * [-1, -1, 1], back.size_m)
        uids = {
            "proposed": label(project, ids[PROPOSED], boxes[PROPOSED][0], state=ReviewState.PROPOSED),
            "face": label(project, ids[FACE], short),
            "turned": label(project, ids[TURNED], turned),
        }
        last: dict[int, OrientedBox] = {}
        for place in range(LENGTH):
            last |= {int(each.track_id or 0): each.box for each in truths[TRACKED + place]}
            for track, box in list(last.items())[:3]:
                # the second one has another number in the second half
                number = track + 10 * (track == 2 and place >= MIDDLE)
                uid = label(project, ids[TRACKED + place], box, track_id=number)
                if place == MIDDLE:
                    uids[f"track {track}"] = uid
    return Room(ids, boxes, read[0].camera, uids)


def label(project: Project, frame: int, box: OrientedBox, name: str = CLASSES[0], **more: Any) -> str:
    """Labels a box; returns its uid."""
    context = WriteContext(project.frames.get(frame).revision, "Ada")
    return project.labels.create(frame, [NewLabel(name, box, **more)], context).uids[0]


def street(folder: Path, projects: Path) -> Drive:
    random, palette = np.random.default_rng(0), Palette()
    grey = palette.add(Material((0.4, 0.4, 0.4)))
    ground = box_mesh((0, 0, -0.25 - EYE_M), (200, 200, 0.5), grey)
    walls = [box_mesh((20, side * 22, 2), (90, 2, 9), grey) for side in (-1, 1)]
    boxes = {}
    for name, (place, size, heading) in STREET.items():
        turn = Rotation.from_euler("z", heading, degrees=True).as_matrix()
        boxes[name] = OrientedBox.from_parts(np.array([*place, size[2] / 2 - EYE_M]), turn, np.array(size))
    things = [box_mesh(box.center_m, box.size_m, grey, box.rotation) for box in boxes.values()]
    (folder / DRIVE).mkdir()
    pose, lights = RigidTransform.identity(), Lights((0.0, 0.0, 30.0))
    for moment in range(2):
        points = scan(Lidar(), pose, np.pi, joined([ground, *walls, *things]), palette, lights, random)
        np.save(folder / DRIVE / f"{moment}.npy", points.xyz_m)
    options = ReaderOptions(look_around=4)
    frame = open_recording(folder / DRIVE, options).frame(0)
    assert frame.T_camera_label is not None
    truths = {name: box.transformed(frame.T_camera_label) for name, box in boxes.items()}
    with create_project(projects, DRIVE, VEHICLES, settings=ProjectSettings(rotation=BoxRotation.UPRIGHT)) as project:
        added = add_recordings(project, [folder / DRIVE], options=options, cameras=[ALL])
        frames = [[each.id for each in project.frames.of([one.recording.id])] for one in added]
        car = truths["Car"]
        center = car.center_m * (1 - 2 / np.linalg.norm(car.center_m))
        moved = label(project, frames[0][1], OrientedBox.from_parts(center, car.rotation, car.size_m), "Car")
    return Drive(frames, truths, frame.camera, moved)


# -- the tasks


def go_to_frame(hand: Hand) -> None:
    """The slider is dragged until its number says so."""
    frames = hand.room.frames
    hand.open(ROOM, frames[0])
    slider = hand.get("timeline-slider").bounding_box()
    assert slider is not None
    # half of the knob at each end
    knob = slider["height"] / 2
    x = [slider["x"] + 7 + n / (FRAMES - 1) * (slider["width"] - 14) for n in (0, GONE_TO - 1)]
    y = slider["y"] + knob
    hand.drag((x[0], y), (x[1], y), shows(ROOM, frames[GONE_TO - 1], f"{GONE_TO} / {FRAMES}"))
    assert hand.shown["index"] == GONE_TO - 1


def shows(project: str, frame: int, position: str = "") -> str:
    """A frame's image is on the page, and its number in the top bar."""
    picture = f"[data-testid=image-editor] img.picture[src*='{project}/frames/{frame}/']"
    at = f"document.querySelector('[data-testid=frame-position]').textContent.includes('{position}')"
    return f'document.querySelector("{picture}")?.complete && {at}'


def other_recording(hand: Hand) -> None:
    hand.open(ROOM, hand.room.frames[0])
    row = hand.get("recordings").get_by_role("button").filter(has_text="others")
    hand.click(hand.get("choose-recordings"), "document.querySelectorAll('[data-testid=recordings] button').length > 1")
    hand.click(row, shows(ROOM, FRAMES + 1))
    assert hand.shown["recording_name"] == "others"


def other_camera(hand: Hand) -> None:
    hand.open(DRIVE, hand.drive.frames[0][0])
    hand.press("k", shows(DRIVE, hand.drive.frames[1][0]))
    assert hand.shown["recording_name"].endswith("around-090")


def take_proposal(hand: Hand) -> None:
    frame = hand.room.frames[PROPOSED]
    hand.open(ROOM, frame, hand.room.uids["proposed"])
    hand.press("Space", lambda: [each["state"] for each in hand.labels(ROOM, frame)] == ["accepted"])


def first_object(hand: Hand) -> None:
    frame, truth = hand.room.frames[0], hand.room.truths[0][0]
    hand.open(ROOM, frame)
    hand.draw(seen(hand.room.camera, truth))
    hand.press("Space", lambda: hand.has(ROOM, frame, CLASSES[0], truth))


def seen(camera: Camera, box: OrientedBox) -> tuple[float, float, float, float]:
    """The edges of a box on the image, pixels."""
    found = box_on_image(camera, box, "")
    assert found is not None
    return found.xyxy


def correct_face(hand: Hand) -> None:
    frame, truth = hand.room.frames[FACE], hand.room.truths[FACE][0]
    hand.open(ROOM, frame, hand.room.uids["face"])
    rect = hand.get("ortho-top").locator("rect.line").bounding_box()
    assert rect is not None
    # the front is up; two thirds of the length are there
    x, y = rect["x"] + 0.25 * rect["width"], rect["y"]
    hand.drag((x, y), (x, y - rect["height"] / 2), lambda: hand.is_exact(ROOM, frame, truth))


def move_along_ray(hand: Hand) -> None:
    frame, truth = hand.drive.frames[0][1], hand.drive.truths["Car"]
    hand.open(DRIVE, frame, hand.drive.moved)
    top = hand.get("ortho-top")
    rect, handle = (top.locator(name).bounding_box() for name in ("rect.line", "[data-testid=sight-handle]"))
    assert rect is not None and handle is not None
    start, middle = (
        np.array([each["x"], each["y"]]) + np.array([each["width"], each["height"]]) / 2 for each in (handle, rect)
    )
    level = np.sqrt(1 - (truth.center_m @ truth.rotation[:, 2] / np.linalg.norm(truth.center_m)) ** 2)
    px = 2 * level * rect["height"] / truth.size_m[0]
    end = start + px * (start - middle) / np.linalg.norm(start - middle)
    hand.drag(tuple(start), tuple(end), lambda: hand.is_exact(DRIVE, frame, truth))


def turn_round(hand: Hand) -> None:
    frame, truth = hand.room.frames[TURNED], hand.room.truths[TURNED][0]
    hand.open(ROOM, frame, hand.room.uids["turned"])
    hand.press("f", lambda: hand.is_exact(ROOM, frame, truth))


TOLD = "document.querySelector('[data-testid=track-count]')?.textContent.startsWith('This')"


def split_track(hand: Hand) -> None:
    hand.open(ROOM, hand.room.frames[TRACKED + MIDDLE], hand.room.uids["track 1"])
    hand.press("e", TOLD)
    hand.press("Enter", lambda: list(hand.track(1)) == hand.room.frames[TRACKED : TRACKED + MIDDLE])


def merge_tracks(hand: Hand) -> None:
    """If the page does not name the right one by itself, its number is typed."""
    hand.open(ROOM, hand.room.frames[TRACKED + MIDDLE], hand.room.uids["track 2"])
    hand.press("Shift+M", "document.querySelector('[data-testid=track-other]')")
    if hand.get("track-other").input_value() != "2":
        hand.type("2")
    until(hand.page, TOLD, PATIENCE_S)
    hand.press("Enter", lambda: list(hand.track(2)) == hand.room.frames[TRACKED : TRACKED + LENGTH])


def reclass_track(hand: Hand) -> None:
    frames = hand.room.frames[TRACKED : TRACKED + LENGTH]
    hand.open(ROOM, frames[MIDDLE], hand.room.uids["track 3"])
    hand.press("Shift+2", TOLD)
    hand.press("Enter", lambda: all("dummy" in {each["label"] for each in hand.labels(ROOM, f)} for f in frames))


def place_far_car(hand: Hand) -> None:
    """In the top view, where nothing is seen; cars are the project's first class."""
    frame, (ahead, left) = hand.drive.frames[0][0], FAR
    hand.open(DRIVE, frame)
    hand.press("m", "document.querySelector('[data-testid=map] circle.ring')")
    root = hand.get("map").bounding_box()
    assert root is not None
    sensor = hand.page.locator("[data-testid=map] circle.sensor")
    ring = hand.page.locator("[data-testid=map] circle.ring").first
    said = hand.page.locator("[data-testid=map] text.ring").first.text_content() or ""
    metres = float(said.split()[0])
    px = float(ring.get_attribute("r") or 0) / metres
    x, y = (float(sensor.get_attribute(name) or 0) for name in ("cx", "cy"))
    at = root["x"] + x - left * px, root["y"] + y - ahead * px
    hand.click(at, "document.querySelector('[data-testid=label-state]')?.textContent === 'new'")

    def is_there() -> bool:
        found = [each for each in hand.labels(DRIVE, frame) if each["label"] == "Car"]
        center = np.array([-left, EYE_M, ahead])
        return any(np.linalg.norm(boxed(each).center_m - center) < NEAR_M and each["points"] < 20 for each in found)

    hand.press("Space", is_there)


def find_unlabelled(hand: Hand) -> None:
    frame, truth = hand.drive.frames[0][1], hand.drive.truths["Pedestrian"]
    hand.open(DRIVE, frame, hand.drive.moved)
    hand.press("u", "document.querySelector('[data-testid=points-color]').value === 'unlabelled'")
    hand.draw(seen(hand.drive.camera, truth), "3")
    hand.press("Space", lambda: hand.has(DRIVE, frame, "Pedestrian", truth))


def truck_of_rig(hand: Hand) -> None:
    """Its box, drawn on one image, is in both that see it."""
    (frame, *_), (beside, *_) = hand.drive.frames[:2]
    truth = hand.drive.truths["Truck"]
    hand.open(DRIVE, frame)
    hand.draw(seen(hand.drive.camera, truth), "2")
    hand.press("Space", lambda: hand.has(DRIVE, frame, "Truck", truth))
    assert [each["label"] for each in hand.labels(DRIVE, beside) if each["outline"]].count("Truck") == 1


def export_while_training(hand: Hand) -> None:
    path = f"/api/projects/{ROOM}/jobs"
    training = answered(hand.client.post(path, json={"kind": "train", "minutes": 10, "roles": ["view"]}))["id"]

    def running() -> bool:
        return any(
            each["id"] == training and each["state"] == "running" for each in answered(hand.client.get("/api/jobs"))
        )

    hand.open(ROOM, hand.room.frames[0])
    try:
        while not running():
            hand.page.wait_for_timeout(200)
        hand.click(hand.get("mode-export"), "document.querySelector('[data-testid=export-start]:enabled')")
        hand.click(hand.get("export-start"), "document.querySelector('[data-testid=download]')")
        with hand.page.expect_download() as download:
            hand.click(hand.get("download"), "true")
        with zipfile.ZipFile(download.value.path()) as opened:
            files = [json.loads(opened.read(name)) for name in opened.namelist() if "/labels/" in name]
        assert sum(len(each["objects"]) for each in files) >= 3 * LENGTH and running()
    finally:
        hand.client.post(f"/api/jobs/{training}/cancel")


@dataclass(frozen=True)
class Task:
    """What is done, the most actions that it may take, and those of other tools."""

    do: Callable[[Hand], None]
    most: int
    cvat: int | None = None
    sustech: int | None = None


# CVAT: the manual in its repository, site/content/en/docs/manual. SUSTechPOINTS: README.md, README_guide.md and
# doc/operations.md of its repository.
TASKS = {
    # CVAT, top panel: `~` goes to the field of the frame's number, which is typed
    "go_to_frame": Task(go_to_frame, 2, cvat=3),
    "other_recording": Task(other_recording, 2),
    "other_camera": Task(other_camera, 1),
    "take_proposal": Task(take_proposal, 1),
    # CVAT, 3D object annotation: the tool, the class and the shape are clicked, and a double click places a cube, which
    # then has to be corrected. SUSTechPOINTS, "Add a new box": Ctrl and a drag around the object
    "first_object": Task(first_object, 2, cvat=4, sustech=1),
    # CVAT, 3D object annotation: a point of the projection is dragged. SUSTechPOINTS, sub-view: so is a border
    "correct_face": Task(correct_face, 1, cvat=1, sustech=1),
    # both: the box is dragged in the view from above, by eye
    "move_along_ray": Task(move_along_ray, 2, cvat=1, sustech=1),
    # CVAT, 3D object annotation: a point is dragged, by eye. SUSTechPOINTS, sub-view: `g`
    "turn_round": Task(turn_round, 1, cvat=1, sustech=1),
    # CVAT, controls sidebar: Split, and a click on the object
    "split_track": Task(split_track, 3, cvat=2),
    # CVAT, track mode: `M`, a click on each of the tracks, `M`; without going to a frame of the other one
    "merge_tracks": Task(merge_tracks, 3, cvat=4),
    # CVAT, objects sidebar: the class is chosen in the track's list. SUSTechPOINTS, "Sync object type & attr": it is
    # chosen in one frame, then a menu copies it to the others
    "reclass_track": Task(reclass_track, 3, cvat=2, sustech=3),
    # CVAT, 3D object annotation: only near points. SUSTechPOINTS, main view: Shift and a drag, and the class is chosen
    "place_far_car": Task(place_far_car, 3, sustech=3),
    "find_unlabelled": Task(find_unlabelled, 4),
    "truck_of_rig": Task(truck_of_rig, 3),
    # CVAT, export datasets: Ctrl+S, the menu, its entry, and the format in a list; the export runs beside other work
    "export_while_training": Task(export_while_training, 4, cvat=5),
}


# -- nothing jumps

# Every shift counts, also one right after an action: that is when the next one is aimed.
WATCH = """() => {
  window.shifts = [];
  const name = ({ node }) => `${node?.parentElement?.className} > ${node?.nodeName} ${node?.textContent?.slice(0, 40)}`;
  const add = (list) =>
    list.getEntries().forEach(({ value, sources }) => window.shifts.push([value, sources.map(name).join("; ")]));
  new PerformanceObserver(add).observe({ type: "layout-shift" });
}"""


def layout_shift(hand: Hand) -> float:
    """The sum of all shifts while `SESSION` boxes are drawn and accepted, some followed, turned, rejected, undone."""
    frames, drawn = hand.room.frames, 0
    hand.open(ROOM, frames[-1])
    hand.page.evaluate(WATCH)
    # the last frames first, so that following is short
    for place in reversed(range(FRAMES)):
        hand.page.evaluate("(hash) => (location.hash = hash)", f"#/{ROOM}/annotate/{frames[place]}")
        until(hand.page, shows(ROOM, frames[place], f"{place + 1} / {FRAMES}"), PATIENCE_S)
        for truth in hand.room.truths[place]:
            if drawn == SESSION:
                shifts = hand.page.evaluate("window.shifts")
                for value, what in shifts:
                    QUIET.print(f"layout shift of {value:.5f}: {what}")
                return sum((value for value, _ in shifts), 0.0)
            hand.draw(seen(hand.room.camera, truth))
            hand.press("Space", "document.querySelector('[data-testid=label-state]')?.textContent !== 'new'")
            drawn += 1
            for key in ("f", "Control+z", "x", "Control+z", "v") if drawn % CHANGED == 0 else ():
                hand.press(key, "true")
                hand.page.wait_for_timeout(300)
    raise ConfigError(f"the room has fewer than {SESSION} objects")


def run(args: Arguments) -> dict[str, Any]:
    names = list(TASKS) if args.task is None else chosen("--task", args.task, TASKS)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        projects = folder / "projects"
        made = room(folder, projects), street(folder, projects)
        with serving(projects) as server, chromium() as browser:
            hand = Hand(browser, server, *made)
            warm(hand)
            tasks = {name: done(hand, name) for name in names}
            shift = layout_shift(hand) if args.task is None else None
    return {"tasks": tasks} | (waiting() | {"layout_shift": shift} if args.task is None else {})


def waiting() -> dict[str, Any]:
    """What the page makes wait for, p95 of the slowest recording; and how many points turn at 20 frames a second."""
    parts = workbench.run(workbench.Arguments(only="next_frame,next_proposal,draw_to_box,points"))

    def worst(part: str, percent: int) -> float:
        return max(each[f"p{percent}_ms"] for each in parts[part].values()) / 1000

    return {
        "draw_to_box_s": {"p50": worst("draw_to_box", 50), "p95": worst("draw_to_box", 95)},
        "next_frame_s": worst("next_frame", 95),
        "next_proposal_s": worst("next_proposal", 95),
        "points_at_20_fps": int(
            max(min(1, each["frames_per_s"] / 20) * each["points"] for each in parts["points"].values())
        ),
    }


def warm(hand: Hand) -> None:
    """Lets the server load the detectors, as at the first box of the day."""
    box = {"label": "", "x_min": 0, "y_min": 0, "x_max": 200, "y_max": 200}
    for project, name in ((ROOM, CLASSES[0]), (DRIVE, VEHICLES[0])):
        answered(hand.client.post(f"/api/projects/{project}/frames/1/fit", json={"image_box": box | {"label": name}}))


def done(hand: Hand, name: str) -> dict[str, Any]:
    """Does a task; returns its figures."""
    task = TASKS[name]
    try:
        task.do(hand)
    except AssertionError as error:
        raise ConfigError(f"{name}: the result is not what it should be") from error
    peers = {"CVAT": task.cvat, "SUSTechPOINTS": task.sustech}
    return {"actions": hand.actions, "wait_s": hand.wait_s, "peers": peers}


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    table = Table("task", "actions", "at most", "s waiting", "CVAT", "SUSTechPOINTS")
    for name, task in result["tasks"].items():
        table.add(name, task["actions"], TASKS[name].most, task["wait_s"], *task["peers"].values())
    return [table, Table.of_figures({name: value for name, value in result.items() if name != "tasks"})]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
