"""Screenshots of every page of the workbench, at three sizes, light and dark: to be looked at after a change of it.

`python docs/pictures pages FOLDER [NAME ...]` writes FOLDER/NAME-WIDTH-light.png and so on; by default of all places.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from page import chromium, drag, go_to, signed_in, workbench
from playwright.sync_api import Page, TimeoutError
from scenes import street_drive
from worked import Work, worked_project

from annotator.project import BoxRotation, NewLabel, Project, ProjectSettings, WriteContext, create_project
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.recordings import ReaderOptions, open_recording
from annotator.synthetic import write_generated
from annotator.types import OrientedBox, ReviewState
from annotator.workflows.add_recordings import ALL, add_recordings, register_recording
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.sample import RECORDING, SAMPLES

SIZES = ((1366, 768), (1920, 1080), (2560, 1440))
THEMES = ("light", "dark")
FRAMES, REVIEWED, SEED = 12, 7, 0
CAMERAS = 6
# Enough that the class is chosen by a search.
CLASSES = (
    "car van truck bus tram person cyclist motorcycle scooter pram dog cart pole sign box bin cone bench tree object"
)
# On the first frame of the table: the upper left and the lower right corner, shares of the picture.
AN_OBJECT = ((0.366, 0.347), (0.422, 0.469))
# The 3D view is drawn in software.
SETTLED_MS, DRAWN_MS, PATIENCE_MS = 700, 3_000, 60_000.0
TRAINED_MIN = 0.5


def main(folder: Path, names: list[str]) -> None:
    """
    Raises:
        SystemExit: an unknown name.
    """
    if unknown := set(names) - set(PLACES):
        sys.exit(f"no such page: {', '.join(sorted(unknown))}; choose from {', '.join(PLACES)}")
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as temporary:
        work = Path(temporary)
        fill(work)
        for is_empty in (True, False):
            here = [name for name in PLACES if (name in EMPTY) == is_empty and (not names or name in names)]
            projects = work / ("none" if is_empty else "projects")
            with workbench(projects, work / "recordings") as address, chromium() as browser:
                page = signed_in(browser, address)
                page.set_default_timeout(PATIENCE_MS)
                for name in here:
                    sys.stderr.write(f"  {name}\n")
                    page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})
                    go_to(page, "")
                    page.reload()
                    try:
                        PLACES[name](page)
                    except TimeoutError as error:
                        sys.stderr.write(f"    not reached: {error}\n")
                    keep(page, folder, name)


def keep(page: Page, folder: Path, name: str) -> None:
    """The page as it is, at all sizes, light and dark."""
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        for theme in THEMES:
            page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
            has_3d = page.locator('[data-testid="viewport"]:visible').count()
            page.wait_for_timeout(DRAWN_MS if has_3d else SETTLED_MS)
            page.screenshot(path=folder / f"{name}-{width}-{theme}.png")


# -- the projects


def fill(work: Path) -> None:
    """Generates the recordings and the projects."""
    recordings, projects = work / "recordings", work / "projects"
    for path in (recordings / "notes", work / "none", projects):
        path.mkdir(parents=True)
    (recordings / "notes" / "readme.txt").write_text("nothing to read here")
    write_generated(recordings / "people", "people", FRAMES, SEED)
    # the sample is there at once
    shutil.copytree(recordings / "people", work / "none" / SAMPLES / RECORDING)
    write_generated(recordings / "table", "objects", 4, 3)
    upright = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    with create_project(projects, "room", ("person", "chair", "table"), settings=upright) as project:
        register_recording(project, open_recording(recordings / "people"))
        register_recording(project, open_recording(recordings / "table"))
        label(project, recordings / "people")
        pose = Attribute(name="pose", kind=AttributeKind.CHOICE, choices=("standing", "sitting"), key="o")
        for attribute in (pose, Attribute(name="helmet", kind=AttributeKind.BOOLEAN, of=AttributeOf.TRACK)):
            project.change_classes(edit.PutAttribute(attribute=attribute), "Ada")
    with create_project(projects, "fresh", ("object",), settings=upright) as project:
        register_recording(project, open_recording(recordings / "table"))
    create_project(projects, "nothing", ("person",)).close()
    truths = street_drive(recordings / "drive", 1, 8)
    with create_project(projects, "street", tuple(CLASSES.split()), settings=upright) as project:
        options = ReaderOptions(look_around=CAMERAS)
        add_recordings(project, [recordings / "drive"], options=options, cameras=(ALL,))
        (ahead, *_) = project.recordings.all()
        for stored, boxes in zip(project.frames.of([ahead.id]), truths, strict=True):
            labels = [
                NewLabel(CLASSES.split()[(each.track_id or 0) % 8], each.box, None, each.track_id) for each in boxes
            ]
            project.labels.create(stored.id, labels, WriteContext(stored.revision, "Ada"))
    with create_project(projects, "damaged", ("object",)) as project:
        write_generated(recordings / "damaged", "objects", 2, 4)
        register_recording(project, open_recording(recordings / "damaged"))
        min((recordings / "damaged" / "color").iterdir()).write_bytes(b"")
    worked_project(projects, "worked", Work(frames=2000, reviewed=1400, days=10)).close()


def label(project: Project, recording: Path) -> None:
    """Reviewed boxes in the first frames, one of them wrong; proposals beside the true places in the others."""
    opened, random = open_recording(recording), np.random.default_rng(SEED)
    for index, stored in enumerate(project.frames.of([1])):
        state = ReviewState.ACCEPTED if index < REVIEWED else ReviewState.PROPOSED
        labels = list[NewLabel]()
        for truth in load_truth(opened, index, opened.frame(index)):
            off = 0.0 if index < REVIEWED else 0.05
            center = truth.box.center_m + random.normal(0, off, 3)
            size = truth.box.size_m * (2.0 if index == 3 and not labels else 1.0)
            box = OrientedBox.from_parts(center, truth.box.rotation, size)
            labels.append(NewLabel(truth.label, box, None if not off else 0.7, truth.track_id, state))
        project.labels.create(stored.id, labels, WriteContext(stored.revision, "Ada"))


# -- the places: each begins at the start page


def at(place: str, *clicks: str, key: str = "") -> Callable[[Page], None]:
    """Opens an address, waits until what it shows is there, then clicks elements by test id, and presses a key."""

    def reach(page: Page) -> None:
        go_to(page, place)
        if "/annotate/" in place:
            page.locator("[data-testid=image-editor] img.picture[src]").first.wait_for()
            page.locator('[data-testid="viewport"][data-state="ready"]').wait_for()
        else:
            page.wait_for_load_state("networkidle")
        for test_id in clicks:
            page.get_by_test_id(test_id).first.click()
        if key:
            page.wait_for_timeout(SETTLED_MS)
            page.keyboard.press(key)

    return reach


def signing_in(page: Page) -> None:
    page.get_by_test_id("operator").click()
    page.get_by_test_id("dialog-yes").click()
    page.get_by_test_id("operator-name").wait_for()
    page.wait_for_timeout(SETTLED_MS)


def folder_of_notes(page: Page) -> None:
    at("", "add-recording-nothing", "folder-recordings", "folder-notes")(page)


def added(page: Page) -> None:
    at("", "add-recording-nothing", "folder-recordings", "add-people")(page)
    page.get_by_test_id("added-recording").wait_for()


def drawn(page: Page) -> None:
    """A box that was just drawn, and its pseudo-views."""
    at("fresh/annotate/1", "views-pseudo")(page)
    shown = page.get_by_test_id("image-editor").locator("img.picture[src]").bounding_box()
    assert shown is not None
    (left, top), (right, low) = (
        (shown["x"] + u * shown["width"], shown["y"] + v * shown["height"]) for u, v in AN_OBJECT
    )
    drag(page, (left, top), (right, low))
    page.get_by_test_id("view-side-2").locator(".box.suggested").wait_for()


def guided(page: Page) -> None:
    """The sample project with its guide."""
    page.get_by_test_id("sample-project").first.click()
    page.get_by_test_id("guide").wait_for()
    page.locator("[data-testid=image-editor] img.picture[src]").first.wait_for()


def training(page: Page) -> None:
    at("room/train")(page)
    page.get_by_test_id("train-minutes").fill(str(TRAINED_MIN))
    page.get_by_test_id("train-start").click()
    page.get_by_test_id("curves-quality").locator(".main-svg").first.wait_for(timeout=5 * PATIENCE_MS)


def trained(page: Page) -> None:
    at("room/train")(page)
    page.get_by_test_id("model-row").first.wait_for(timeout=5 * PATIENCE_MS)


def exported(page: Page) -> None:
    at("room/export", "export-divide")(page)
    page.get_by_test_id("export-format").select_option("kitti")
    page.get_by_test_id("export-start").click()
    page.get_by_test_id("download").wait_for()


def statistics(page: Page) -> None:
    at("worked/statistics")(page)
    page.get_by_test_id("work-classes").locator(".main-svg").first.wait_for()


PLACES: dict[str, Callable[[Page], None]] = {
    "start-empty": at(""),
    "start-sample": guided,
    "start": at(""),
    "new-project": at("", "new-project"),
    "menu": at("", "menu-room"),
    "folders": at("", "add-recording-nothing", "folder-recordings"),
    "folders-unknown": folder_of_notes,
    "folders-added": added,
    "recordings": at("", "menu-room", "recordings-room"),
    "rename": at("", "menu-room", "rename-room"),
    "copy": at("", "menu-room", "copy-room"),
    "remove": at("", "menu-room", "remove-room"),
    "boxes": at("", "import-boxes-room"),
    "classes": at("", "edit-classes-room"),
    "classes-many": at("", "edit-classes-street"),
    "attribute": at("", "edit-classes-room", "add-attribute"),
    "keys": at("room/statistics", "help"),
    "missing": at("no-such-project/annotate"),
    "annotate-frame": at("room/annotate/3", key="Tab"),
    "annotate-queue": at("room/annotate/8", "queue-item"),
    "annotate-open": at("fresh/annotate/1"),
    "annotate-drawn": drawn,
    "annotate-empty": at("nothing/annotate"),
    "annotate-broken": at("damaged/annotate"),
    "annotate-rig": at("street/annotate/1", key="Tab"),
    "annotate-sheet": at("room/annotate/3?track=1", key="s"),
    "annotate-class": at("street/annotate/1", key="/"),
    "annotate-cameras": at("street/annotate/1", "choose-cameras"),
    "annotate-recordings": at("room/annotate/1", "choose-recordings"),
    "annotate-track": at("room/annotate/3?track=1", key="e"),
    # the last of these: the page keeps the top view
    "annotate-map": at("street/annotate/2", key="m"),
    "alignment": at("room/alignment/1"),
    "alignment-lidar": at("street/alignment/1"),
    "train-empty": at("nothing/train"),
    "train": at("room/train"),
    "train-running": training,
    "train-done": trained,
    "checks": at("room/checks"),
    "checks-empty": at("fresh/checks"),
    "export": at("room/export"),
    "export-empty": at("fresh/export"),
    "export-done": exported,
    "statistics": statistics,
    "statistics-empty": at("fresh/statistics"),
    # the last: it signs out
    "sign-in": signing_in,
}
# In a folder without projects.
EMPTY = {"start-empty", "start-sample"}
