"""Everyday tasks in Annotate, done in Chromium with a mouse and keys: how many actions they take, and the waiting.

    python -m benchmarks.desk [--task NAME] [--json]

An action is a click, a drag or a key, also with Ctrl or Shift; a word that is typed into a field is one, and the Enter
after it another. `wait_s` is the time until what each action asks for is there. A task counts only if the server has
stored what it should lead to. Everything is generated: people in a room, and a scan of a street that four virtual
cameras see. A task begins with its frame open and its box selected, if it has one, in a page that knows no habits.

`peers` are the same counts of other tools by what they publish about themselves: for the first box as the tool gives
it; null where that does not say how it is done. Without `--task`, the waiting times are those of
`benchmarks.workbench`, and `layout_shift` is the sum of all shifts in a session of 50 boxes.
"""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
from benchmarks.served import PRESET, Server, answered, chromium, drag, on_page, open_frame, serving, signed_in, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator

Point = tuple[float, float]
Result = str | Callable[[], bool]
"""An expression of the page, or of what the server has, that is true when an action has done what it should."""

ROOM, DRIVE, CLASSES, VEHICLES = "room", "drive", ("person", "dummy"), ("Car", "Truck", "Pedestrian")
# Frames of the room. The first ones have a box each for a task; then come three tracks, and where they are selected.
FRAMES, GONE_TO, TRACKED, LENGTH, MIDDLE = 100, 17, 5, 25, 12
# Boxes of a session. In every second of its frames, one of them is changed in all ways.
SESSION, CHANGED = 50, 2
# On the street, x ahead, y to the left: place, size and heading. The far car has no points.
FAR = "far Car"
STREET = {
    FAR: ((42.0, 6.0), (4.3, 1.8, 1.5), 0.0),
    "Truck": ((10.7, 9.0), (8.0, 2.5, 3.2), 130.0),
    "Pedestrian": ((9.0, -3.0), (0.6, 0.7, 1.75), 0.0),
    "Car": ((18.0, -7.0), (4.3, 1.8, 1.5), 80.0),
}
EYE_M, MOVED_M = 1.8, 2.0
# A drawn or placed box is right from this IoU on; a corrected one with corners this near; one that is placed where
# there are no points holds no more than the ground gives it.
RIGHT, EXACT_M, GROUND_POINTS = 0.5, 0.05, 20
PATIENCE_S = 600.0
IS_NEW = "document.querySelector('[data-testid=label-state]')?.textContent === 'new'"
TOLD = "document.querySelector('[data-testid=track-count]')?.textContent.startsWith('This')"


@dataclass
class Arguments(Options):
    task: str | None = None
    """The only task to do; by default all, and what the page makes wait for."""


# -- the recordings, and what is labelled in them before


@dataclass(frozen=True)
class Start:
    """Where a task begins: a frame, the object that the task is about as its camera sees it, and the selected label."""

    project: str
    frame: int
    camera: Camera
    name: str
    truth: OrientedBox
    uid: str = ""


def room(folder: Path, projects: Path) -> tuple[list[int], dict[str, Start], list[Start]]:
    """People in a room: the ids of the frames, where tasks begin, and all objects in the order of a session."""
    for name, count, seed in ((PRESET, FRAMES, 0), ("others", 2, 1)):
        write_generated(folder / name, PRESET, count, seed, 320, 240)
    recording = open_recording(folder / PRESET)
    read = [recording.frame(index) for index in range(FRAMES)]
    truths = [load_truth(recording, index, frame) for index, frame in enumerate(read)]
    camera, name = read[0].camera, CLASSES[0]
    with create_project(projects, ROOM, CLASSES, settings=ProjectSettings(rotation=BoxRotation.UPRIGHT)) as project:
        add_recordings(project, [folder / PRESET, folder / "others"])
        frames = [frame.id for frame in project.frames.of([1])]
        objects = [
            Start(ROOM, frame, camera, name, truth.box)
            for frame, each in zip(frames, truths, strict=True)
            for truth in each
        ]
        _, proposed, short, turned = (next(one for one in objects if one.frame == frame) for frame in frames[:4])
        # a third of its length is missing in front
        box, cut = short.truth, np.array([short.truth.size_m[0] / 3, 0.0, 0.0])
        cropped = OrientedBox.from_parts(box.center_m - box.rotation @ cut / 2, box.rotation, box.size_m - cut)
        back = turned.truth.rotation * [-1, -1, 1]
        starts = {
            "go_to_frame": objects[0],
            "other_recording": objects[0],
            "first_object": objects[0],
            "take_proposal": labelled(project, proposed, proposed.truth, state=ReviewState.PROPOSED),
            "correct_face": labelled(project, short, cropped),
            "turn_round": labelled(
                project, turned, OrientedBox.from_parts(turned.truth.center_m, back, turned.truth.size_m)
            ),
            "export_while_training": objects[0],
        }
        boxes: dict[int, OrientedBox] = {}
        for place in range(LENGTH):
            # who is hidden stays where they were
            boxes |= {int(each.track_id or 0): each.box for each in truths[TRACKED + place]}
            for track, task in enumerate(("split_track", "merge_tracks", "reclass_track"), 1):
                # the one to be merged has another number in its second half
                number = 12 if task == "merge_tracks" and place >= MIDDLE else track
                one = Start(ROOM, frames[TRACKED + place], camera, name, boxes[track])
                one = labelled(project, one, boxes[track], track_id=number)
                if place == MIDDLE:
                    starts[task] = one
    return frames, starts, objects[::-1]


def labelled(project: Project, start: Start, box: OrientedBox, **more: Any) -> Start:
    """Labels an object with a box, which is selected."""
    context = WriteContext(project.frames.get(start.frame).revision, "Ada")
    return replace(start, uid=project.labels.create(start.frame, [NewLabel(start.name, box, **more)], context).uids[0])


def street(folder: Path, projects: Path) -> dict[str, Start]:
    """A street that four cameras see at two moments: where tasks begin."""
    random, palette = np.random.default_rng(0), Palette()
    grey, boxes = palette.add(Material((0.4, 0.4, 0.4))), {}
    for name, (place, size, heading) in STREET.items():
        turn = Rotation.from_euler("z", heading, degrees=True).as_matrix()
        boxes[name] = OrientedBox.from_parts(np.array([*place, size[2] / 2 - EYE_M]), turn, np.array(size))
    things = [box_mesh(box.center_m, box.size_m, grey, box.rotation) for name, box in boxes.items() if name != FAR]
    things += [box_mesh((20, side * 22, 2), (90, 2, 9), grey) for side in (-1, 1)]
    mesh = joined([box_mesh((0, 0, -0.25 - EYE_M), (200, 200, 0.5), grey), *things])
    (folder / DRIVE).mkdir()
    for moment in range(2):
        points = scan(Lidar(), RigidTransform.identity(), np.pi, mesh, palette, Lights((0.0, 0.0, 30.0)), random)
        np.save(folder / DRIVE / f"{moment}.npy", points.xyz_m)
    options = ReaderOptions(look_around=4)
    read = open_recording(folder / DRIVE, options).frame(0)
    beside = open_recording(folder / DRIVE, options.model_copy(update={"camera": "around-090"})).frame(0)
    assert read.T_camera_label is not None and beside.T_camera_label is not None
    truths = {name: box.transformed(read.T_camera_label) for name, box in boxes.items()}
    with create_project(projects, DRIVE, VEHICLES, settings=ProjectSettings(rotation=BoxRotation.UPRIGHT)) as project:
        ahead = add_recordings(project, [folder / DRIVE], options=options, cameras=[ALL])[0].recording
        first, second = (frame.id for frame in project.frames.of([ahead.id]))
        cameras = {each.name.split("@")[-1]: project.frames.first(each.id) for each in project.recordings.all()}
        seen = boxes["Truck"].transformed(beside.T_camera_label)
        in_both = Start(DRIVE, cameras["around-090"] or 0, beside.camera, "Truck", seen)
        truck, far, car, person = (
            Start(DRIVE, frame, read.camera, name.split()[-1], truths[name])
            for name, frame in (("Truck", first), (FAR, first), ("Car", second), ("Pedestrian", second))
        )
        box = car.truth
        nearer_m = box.center_m * (1 - MOVED_M / np.linalg.norm(box.center_m))
        car = labelled(project, car, OrientedBox.from_parts(nearer_m, box.rotation, box.size_m))
    return {
        "other_camera": truck,
        "move_along_ray": car,
        "place_far_car": far,
        "find_unlabelled": replace(person, uid=car.uid),
        "truck_of_rig": truck,
        "truck_beside": in_both,
    }


# -- the operator


class Hand:
    """The operator's mouse and keys, and a count of what they do. `client` prepares and checks without them."""

    def __init__(self, browser: Browser, server: Server, frames: list[int], starts: dict[str, Start]) -> None:
        self._browser, self._server, self.client = browser, server, server.client("Ada")
        self.page = signed_in(browser, server)
        self.get = self.page.get_by_test_id
        self.frames, self.starts = frames, starts
        self.at = starts["first_object"]
        self.actions, self.wait_s = 0, 0.0

    def begin(self, name: str) -> None:
        """Opens the start of a task in a new browser, and begins to count."""
        self.page.context.close()
        self.page = signed_in(self._browser, self._server)
        self.get = self.page.get_by_test_id
        self.at = self.starts[name]
        open_frame(self.page, self.at.project, self.at.frame, self.at.uid)
        if self.at.uid:
            shown = "document.querySelector('[data-testid=orthos]')?.dataset.shown"
            until(self.page, f"{shown} === '{self.at.uid}'", PATIENCE_S)
        self.actions, self.wait_s = 0, 0.0

    def press(self, key: str, result: Result) -> None:
        self.page.keyboard.press(key)
        self._acted(result)

    def click(self, at: Point, result: Result) -> None:
        self.page.mouse.click(*at)
        self._acted(result)

    def drag(self, start: Point, end: Point, result: Result) -> None:
        drag(self.page, start, end)
        self._acted(result)

    def draw(self, key: str = "") -> None:
        """Drags around the object on the image, with the key of its class during the drag, to a dashed 3D box."""
        box = box_on_image(self.at.camera, self.at.truth, "")
        assert box is not None
        self.actions += bool(key)
        drag(self.page, on_page(self.page, *box.xyxy[:2]), on_page(self.page, *box.xyxy[2:]), key)
        self._acted(IS_NEW)

    def _acted(self, result: Result) -> None:
        self.actions += 1
        begin = time.perf_counter()
        if isinstance(result, str):
            is_saved = "!document.querySelector('.annotate[data-saving]')"
            self.page.wait_for_function(f"() => {is_saved} && {result}", timeout=1000 * PATIENCE_S)
        else:
            while not result():
                assert time.perf_counter() - begin < PATIENCE_S
                self.page.wait_for_timeout(20)
        self.wait_s += time.perf_counter() - begin

    # -- what the server has

    def shown(self) -> dict[str, Any]:
        """The frame that the page shows."""
        frame = self.page.url.split("/annotate/")[1].split("?")[0]
        return dict(answered(self.client.get(f"/api/projects/{self.at.project}/frames/{frame}"))["frame"])

    def reviewed(self, frame: int | None = None) -> list[tuple[dict[str, Any], OrientedBox]]:
        """The reviewed labels of the object's class in a frame, by default that of the start, and their boxes."""
        path = f"/api/projects/{self.at.project}/frames/{frame or self.at.frame}"
        found = [each for each in answered(self.client.get(path))["labels"] if each["label"] == self.at.name]
        parts = ("center", "rotation", "size")
        return [
            (each, OrientedBox.from_parts(*(np.array(each["box"][part]) for part in parts)))
            for each in found
            if each["state"] in ("accepted", "edited")
        ]

    def is_right(self) -> bool:
        """Whether the object has a right box."""
        return any(iou_3d(box, self.at.truth) >= RIGHT for _, box in self.reviewed())

    def is_exact(self) -> bool:
        """Whether the object's only box has the corners and the heading of the true one."""
        boxes = [box for _, box in self.reviewed()] + [self.at.truth]
        ends = [each.center_m + each.rotation @ (side * each.size_m / 2) for side in (-1, 1) for each in boxes]
        return len(boxes) == 2 and bool(np.abs(np.array(ends[::2]) - ends[1::2]).max() < EXACT_M)

    def lane(self, number: int) -> list[list[Any]]:
        """Where a track of the room has boxes: places of the first and last frame, class, and doubt (0: reviewed)."""
        lanes = answered(self.client.get(f"/api/projects/{ROOM}/recordings/1/tracks"))["lanes"]
        return next((each["spans"] for each in lanes if each["track_id"] == number), [])


def middle(where: Locator) -> Point:
    """The middle of an element of the page."""
    rect = where.bounding_box()
    assert rect is not None
    return rect["x"] + rect["width"] / 2, rect["y"] + rect["height"] / 2


def shows(project: str, frame: int, position: str = "") -> str:
    """A frame's image is on the page, and its number in the top bar."""
    picture = f"[data-testid=image-editor] img.picture[src*='{project}/frames/{frame}/']"
    at = f"document.querySelector('[data-testid=frame-position]').textContent.includes('{position}')"
    return f'document.querySelector("{picture}")?.complete && {at}'


# -- the tasks


Do = Callable[[Hand], None]
# What is done, the most actions that it may take, and those of other tools, by name.
TASKS: dict[str, tuple[Do, int, dict[str, int | None]]] = {}


def task(most: int, cvat: int | None = None, sustech: int | None = None) -> Callable[[Do], None]:
    def keep(do: Do) -> None:
        TASKS[do.__name__] = do, most, {"CVAT": cvat, "SUSTechPOINTS": sustech}

    return keep


# The sources of the other counts are CVAT's manual, in its repository in site/content/en/docs/manual, and README.md,
# README_guide.md and doc/operations.md in the repository of SUSTechPOINTS.


# CVAT, top panel: `~` goes to the field of the frame's number, which is typed
@task(2, cvat=3)
def go_to_frame(hand: Hand) -> None:
    """The slider is dragged until the number beside it is right."""
    slider = hand.get("timeline-slider")
    (x, y), rect = middle(slider), slider.bounding_box()
    assert rect is not None
    # the middle of its knob, which has 14 px, goes so far
    reach = (rect["width"] - 14) / 2
    start, end = ((x + reach * (2 * place / (FRAMES - 1) - 1), y) for place in (0, GONE_TO - 1))
    hand.drag(start, end, shows(ROOM, hand.frames[GONE_TO - 1], f"{GONE_TO} / {FRAMES}"))
    assert hand.shown()["index"] == GONE_TO - 1


@task(2)
def other_recording(hand: Hand) -> None:
    rows = hand.get("recordings").get_by_role("button")
    hand.click(middle(hand.get("choose-recordings")), "document.querySelector('[data-testid=recordings] button')")
    hand.click(middle(rows.filter(has_text="others")), shows(ROOM, FRAMES + 1))
    assert hand.shown()["recording_name"] == "others"


@task(1)
def other_camera(hand: Hand) -> None:
    hand.press("k", lambda: hand.shown()["recording_name"].endswith("@around-090"))


@task(1)
def take_proposal(hand: Hand) -> None:
    hand.press("Space", hand.is_exact)


# CVAT, 3D object annotation: the tool, the class and the shape are clicked, and a double click places a cube of one
# size. SUSTechPOINTS, "Add a new box": Ctrl and a drag around the object
@task(2, cvat=4, sustech=1)
def first_object(hand: Hand) -> None:
    hand.draw()
    hand.press("Space", hand.is_right)


# CVAT, 3D object annotation: a point of a projection is dragged. SUSTechPOINTS, sub-view: a border
@task(1, cvat=1, sustech=1)
def correct_face(hand: Hand) -> None:
    rect = hand.get("ortho-top").locator("rect.line").bounding_box()
    assert rect is not None
    # the front is up; two thirds of the length are there
    x, y = rect["x"] + 0.25 * rect["width"], rect["y"]
    hand.drag((x, y), (x, y - rect["height"] / 2), hand.is_exact)


# both: the box is dragged in the view from above, by eye
@task(2, cvat=1, sustech=1)
def move_along_ray(hand: Hand) -> None:
    top, truth = hand.get("ortho-top"), hand.at.truth
    rect = top.locator("rect.line").bounding_box()
    assert rect is not None
    start, center = np.array(middle(top.get_by_test_id("sight-handle"))), np.array(middle(top.locator("rect.line")))
    # as much of the ray as lies in this view
    level = np.sqrt(1 - (truth.center_m @ truth.rotation[:, 2] / np.linalg.norm(truth.center_m)) ** 2)
    px = MOVED_M * level * rect["height"] / truth.size_m[0]
    x, y = start + px * (start - center) / np.linalg.norm(start - center)
    hand.drag((start[0], start[1]), (x, y), hand.is_exact)


# CVAT, 3D object annotation: a point is dragged, by eye. SUSTechPOINTS, sub-view: `g`
@task(1, cvat=1, sustech=1)
def turn_round(hand: Hand) -> None:
    hand.press("f", hand.is_exact)


# CVAT, controls sidebar: Split, and a click on the object
@task(3, cvat=2)
def split_track(hand: Hand) -> None:
    hand.press("e", TOLD)
    hand.press("Enter", lambda: hand.lane(1) == [[TRACKED, TRACKED + MIDDLE - 1, CLASSES[0], 0]])


# CVAT, track mode: `M`, a click on a box of each, in frames that are gone to, and `M`
@task(3, cvat=4)
def merge_tracks(hand: Hand) -> None:
    """The page names the likeliest other one."""
    hand.press("Shift+M", TOLD)
    hand.press("Enter", lambda: hand.lane(2) == [[TRACKED, TRACKED + LENGTH - 1, CLASSES[0], 0]])


# CVAT, objects sidebar: a class is chosen in a list. SUSTechPOINTS, "Sync object type & attr": it is chosen in one
# frame, and a menu copies it to the others
@task(3, cvat=2, sustech=3)
def reclass_track(hand: Hand) -> None:
    hand.press("Shift+2", TOLD)
    hand.press("Enter", lambda: hand.lane(3) == [[TRACKED, TRACKED + LENGTH - 1, CLASSES[1], 0]])


# CVAT, 3D object annotation: only near points. SUSTechPOINTS, main view: Shift and a drag; a class is chosen in a list
@task(3, sustech=3)
def place_far_car(hand: Hand) -> None:
    """In the top view. Cars are the project's first class."""
    hand.press("m", "document.querySelector('[data-testid=map] circle.ring')")
    ring, text = (hand.get("map").locator(name).first for name in ("circle.ring", "text.ring"))
    px = float(ring.get_attribute("r") or 0) / float((text.text_content() or "").removesuffix(" m"))
    (x, y), (right_m, _, ahead_m) = middle(hand.get("map").locator("circle.sensor")), hand.at.truth.center_m
    hand.click((x + right_m * px, y - ahead_m * px), IS_NEW)

    def is_there() -> bool:
        return any(
            iou_3d(box, hand.at.truth) >= RIGHT and each["points"] < GROUND_POINTS for each, box in hand.reviewed()
        )

    hand.press("Space", is_there)


@task(4)
def find_unlabelled(hand: Hand) -> None:
    """A key makes it stand out in the 3D view, and offers a box of it."""
    hand.press("u", "document.querySelector('[data-testid=points-color]').value === 'unlabelled'")
    hand.press("u", IS_NEW)
    hand.press("Space", hand.is_right)


@task(3)
def truck_of_rig(hand: Hand) -> None:
    """It is drawn on one camera's image, and then in both that see it."""
    hand.draw("2")
    hand.press("Space", hand.is_right)
    hand.at = hand.starts["truck_beside"]
    assert hand.is_right()


# CVAT, export datasets: Ctrl+S, the menu, its entry, and the format in a list
@task(4, cvat=5)
def export_while_training(hand: Hand) -> None:
    request = {"kind": "train", "minutes": 10, "roles": ["view"]}
    training = answered(hand.client.post(f"/api/projects/{ROOM}/jobs", json=request))["id"]

    def is_training() -> bool:
        jobs = {each["id"]: each["state"] for each in answered(hand.client.get("/api/jobs"))}
        return bool(jobs[training] == "running")

    try:
        while not is_training():
            hand.page.wait_for_timeout(200)
        hand.click(middle(hand.get("mode-export")), "document.querySelector('[data-testid=export-start]:enabled')")
        hand.click(middle(hand.get("export-start")), "document.querySelector('[data-testid=download]')")
        with hand.page.expect_download() as download:
            hand.click(middle(hand.get("download")), "true")
        with zipfile.ZipFile(download.value.path()) as opened:
            files = [json.loads(opened.read(name)) for name in opened.namelist() if "/labels/" in name]
        assert sum(len(each["objects"]) for each in files) >= 3 * LENGTH and is_training()
    finally:
        hand.client.post(f"/api/jobs/{training}/cancel")


# -- nothing jumps

# Every shift counts, also one right after an action: that is when the next one is aimed.
WATCH = """() => {
  window.shifts = [];
  const name = ({ node }) => `${node?.parentElement?.className} > ${node?.nodeName} ${node?.textContent?.slice(0, 40)}`;
  const add = (list) =>
    list.getEntries().forEach(({ value, sources }) => window.shifts.push([value, sources.map(name).join("; ")]));
  new PerformanceObserver(add).observe({ type: "layout-shift" });
}"""


def layout_shift(hand: Hand, objects: Sequence[Start]) -> float:
    """The sum of all shifts while objects are drawn and accepted, and some followed, turned, rejected, undone."""
    hand.begin("first_object")
    hand.page.evaluate(WATCH)
    for number, hand.at in enumerate(objects, 1):
        position = f"{hand.frames.index(hand.at.frame) + 1} / {FRAMES}"
        hand.page.evaluate("(hash) => (location.hash = hash)", f"#/{ROOM}/annotate/{hand.at.frame}")
        until(hand.page, shows(ROOM, hand.at.frame, position), PATIENCE_S)
        hand.draw()
        hand.press("Space", f"!({IS_NEW})")
        # following goes to another frame, as the next object does
        is_last = objects[number % len(objects)].frame != hand.at.frame
        for key in ("f", "Control+z", "x", "Control+z", "v") if is_last and hand.at.frame % CHANGED == 0 else ():
            hand.press(key, "true")
            hand.page.wait_for_timeout(300)
    shifts = hand.page.evaluate("window.shifts")
    for value, what in shifts:
        QUIET.print(f"layout shift of {value:.5f}: {what}")
    return sum((value for value, _ in shifts), 0.0)


def run(args: Arguments) -> dict[str, Any]:
    names = list(TASKS) if args.task is None else chosen("--task", args.task, TASKS)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        projects = folder / "projects"
        frames, starts, objects = room(folder, projects)
        with serving(projects) as server, chromium() as browser:
            hand = Hand(browser, server, frames, starts | street(folder, projects))
            warm(hand)
            result: dict[str, Any] = {"tasks": {name: done(hand, name) for name in names}}
            if args.task is None:
                # the last frames first, so that following is short
                result["layout_shift"] = layout_shift(hand, objects[:SESSION])
    return result | (waiting() if args.task is None else {})


def warm(hand: Hand) -> None:
    """Lets the server load the detectors, as before the first box of the day."""
    box = {"x_min": 0, "y_min": 0, "x_max": 200, "y_max": 200}
    for project, name in ((ROOM, CLASSES[0]), (DRIVE, VEHICLES[0])):
        answered(hand.client.post(f"/api/projects/{project}/frames/1/fit", json={"image_box": box | {"label": name}}))


def done(hand: Hand, name: str) -> dict[str, Any]:
    """Does a task; returns its figures."""
    do, _, peers = TASKS[name]
    hand.begin(name)
    try:
        do(hand)
    except AssertionError as error:
        raise ConfigError(f"{name}: the result is not what it should be") from error
    return {"actions": hand.actions, "wait_s": hand.wait_s, "peers": peers}


def waiting() -> dict[str, Any]:
    """What the page makes wait for on the slowest recording, p95; and how many points turn at 20 frames a second."""
    parts = workbench.run(workbench.Arguments(only="next_frame,next_proposal,draw_to_box,points"))

    def seconds(part: str, percent: int = 95) -> float:
        return max(each[f"p{percent}_ms"] for each in parts[part].values()) / 1000

    most = max(min(1, each["frames_per_s"] / 20) * each["points"] for each in parts["points"].values())
    return {
        "draw_to_box_s": {"p50": seconds("draw_to_box", 50), "p95": seconds("draw_to_box")},
        "next_frame_s": seconds("next_frame"),
        "next_proposal_s": seconds("next_proposal"),
        "points_at_20_fps": int(most),
    }


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    table = Table("task", "actions", "at most", "s waiting", "CVAT", "SUSTechPOINTS")
    for name, figures in result["tasks"].items():
        table.add(name, figures["actions"], TASKS[name][1], figures["wait_s"], *figures["peers"].values())
    return [table, Table.of_figures({name: value for name, value in result.items() if name != "tasks"})]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
