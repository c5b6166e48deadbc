"""The pictures of docs/guide.md: one session at the page, from an empty projects folder to a downloaded dataset.

`python docs/pictures calibration` makes only those of a bag's topics and of Alignment, and `statistics` that of the
statistics; they need no detector.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from page import (
    DOCS,
    REPOSITORY,
    chromium,
    corners_on_page,
    drag,
    go_to,
    save_jpeg,
    shot,
    signed_in,
    wait_for_3d,
    workbench,
)
from playwright.sync_api import Browser, Page
from scenes import unlabelled_boxes
from scipy.spatial.transform import Rotation
from worked import Work, worked_project

from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import Box2D, Camera

# As in the guide's first command.
FRAMES, SEED = 24, 0
# The first frame, which is followed, and one in which somebody is visible again who was lost: what is not followed from
# there is left for the detectors. Frame ids of the only recording.
LABELLED = (1, 20)
WIDTH, MOST_BYTES = 1000, 85_000
# Shorter than a user would train: the page is to be shown, not the best detector.
MINUTES = 1
SETTLED_MS = 1_500
# Of the bag: the time of its first frame and between two, and how far its clouds are turned, degrees.
BEGIN_NS, EVERY_NS, OFF_DEG = 1_700_000_000 * 10**9, 10**8, 2.0


def main() -> None:
    with TemporaryDirectory() as folder:
        recordings, projects = Path(folder) / "recordings", Path(folder) / "projects"
        projects.mkdir()
        write_generated(recordings / "room", "people", FRAMES, SEED)
        with workbench(projects, recordings) as address, chromium() as browser:
            page = signed_in(browser, address)
            create(page)
            for frame in LABELLED:
                camera, boxes = unlabelled_boxes(projects / "room", recordings / "room", frame)
                if not boxes:
                    continue
                go_to(page, f"room/annotate/{frame}")
                draw(page, camera, boxes)
                if frame == LABELLED[0]:
                    follow(page)
                    accept_all(page)
            train(page)
            propose(page)
            page.get_by_test_id("review-proposals").click()
            select_first(page)
            keep(page, "guide_review")
            accept_all(page)
            check(page)
            export(page)
    calibration()
    statistics()


def calibration() -> None:
    """The dialog with the topics of a bag, and Alignment with a cloud that lies beside its image."""
    with TemporaryDirectory() as folder:
        recordings, projects = Path(folder) / "recordings", Path(folder) / "projects"
        projects.mkdir()
        write_generated(recordings / "room", "people", 3, SEED)
        write_bag(recordings, "room")
        with workbench(projects, recordings) as address, chromium() as browser:
            choose_topics(browser, address)


def statistics() -> None:
    """The statistics of a project on which three people have worked for two weeks."""
    with TemporaryDirectory() as folder:
        projects, recordings = Path(folder) / "projects", Path(folder) / "recordings"
        recordings.mkdir()
        worked_project(projects, "street", Work(frames=2000, reviewed=1400, days=10)).close()
        with workbench(projects, recordings) as address, chromium() as browser:
            page = signed_in(browser, address)
            # the link itself would sign in once more, and lead to the start page
            page.evaluate("location.hash = '#/street/statistics'")
            page.get_by_test_id("work-classes").locator(".main-svg").first.wait_for()
            keep(page, "guide_statistics")


def choose_topics(browser: Browser, address: str) -> None:
    page = signed_in(browser, address)
    click(page, "new-project")
    page.get_by_test_id("project-name").fill("room")
    page.get_by_test_id("project-classes").fill("person")
    click(page, "dialog-create")
    click(page, "folder-recordings")
    click(page, "add-room.bag")
    page.get_by_test_id("topic-image").select_option("/front/image_raw")
    page.get_by_test_id("topics-preview").wait_for()
    keep(page, "guide_topics")
    page.get_by_test_id("topics-dialog").get_by_test_id("dialog-add").click()
    page.get_by_test_id("added-recording").wait_for()
    page.keyboard.press("Escape")
    go_to(page, "room/alignment")
    page.get_by_test_id("correction-effect").get_by_text("Undo restores everything").wait_for()
    click(page, "estimate-up")
    page.get_by_text("Proposed with certainty").wait_for()
    page.get_by_test_id("turn-y-field").fill(str(OFF_DEG))
    # thousands of points do not compress
    keep(page, "guide_alignment", 2 * MOST_BYTES)


def write_bag(recordings: Path, name: str) -> None:
    """A bag of the recording `name`: two cameras, one of them with depth, and one whose cloud is turned a little."""
    sys.path.append(str(REPOSITORY / "tests" / "recordings"))
    from bag_writer import BagWriter, structured  # type: ignore[import-not-found]

    recording = open_recording(recordings / name)
    with BagWriter(recordings, "ros1") as bag:
        for index in range(len(recording)):
            frame, time_ns = recording.frame(index), BEGIN_NS + index * EVERY_NS
            xyz = Rotation.from_euler("y", -OFF_DEG, degrees=True).apply(frame.cloud.xyz_m[::5])
            for camera, rgb in (("front", frame.rgb), ("rear", frame.rgb[:, ::-1])):
                size = frame.camera.width_px, frame.camera.height_px
                bag.info(f"/{camera}/camera_info", time_ns, size, frame.camera.matrix)
                bag.image(f"/{camera}/image_raw", time_ns, rgb, "rgb8")
            bag.cloud("/lidar/points", time_ns, structured(dict(zip("xyz", xyz.T, strict=True))), frame="camera")
    bag.path.rename(recordings / f"{name}.bag")


def keep(page: Page, name: str, most_bytes: int = MOST_BYTES) -> None:
    """Saves what the page shows."""
    page.wait_for_timeout(SETTLED_MS)
    save_jpeg(shot(page), DOCS / f"{name}.jpg", WIDTH, most_bytes)


def click(page: Page, test_id: str) -> None:
    page.get_by_test_id(test_id).first.click()


def create(page: Page) -> None:
    """A project with a class, and its recording."""
    click(page, "new-project")
    page.get_by_test_id("project-name").fill("room")
    page.get_by_test_id("project-classes").fill("person")
    page.get_by_test_id("rotation-upright").check()
    keep(page, "guide_project")
    click(page, "dialog-create")
    click(page, "folder-recordings")
    page.get_by_test_id("own-labels").uncheck()
    click(page, "add-room")
    page.get_by_test_id("added-recording").wait_for()
    keep(page, "guide_recording")
    page.keyboard.press("Escape")
    click(page, "open-room")


def draw(page: Page, camera: Camera, boxes: list[Box2D]) -> None:
    """Draws boxes on the image, and accepts the suggested ones; the first time, one of them is moved."""
    picture = page.get_by_test_id("image-editor").locator("img.picture[src]")
    picture.wait_for()
    is_first = page.get_by_test_id("kind-box").get_attribute("aria-checked") == "false"
    click(page, "views-pseudo")
    click(page, "kind-box")
    for number, box in enumerate(boxes, start=1):
        drag(page, *corners_on_page(page, "image-editor", box, camera))
        page.get_by_test_id("view-side-2").locator(".box.suggested").wait_for()
        if is_first:
            is_first = False
            wait_for_3d(page)
            keep(page, "guide_draw")
            correct(page)
            keep(page, "guide_correct")
        page.keyboard.press("Space")
        page.locator('[data-testid="frame-box"][data-state="accepted"]').nth(number - 1).wait_for()
        page.wait_for_timeout(SETTLED_MS)
    click(page, "views-along")


def correct(page: Page) -> None:
    """Moves the lower edge of the suggested box on the first view."""
    shown = page.get_by_test_id("view-front").locator(".box.suggested").first.bounding_box()
    assert shown is not None
    middle, low = shown["x"] + shown["width"] / 2, shown["y"] + shown["height"]
    drag(page, (middle, low), (middle, low + 0.06 * shown["height"]))
    page.get_by_text("2 of 5 boxes").wait_for()


def follow(page: Page) -> None:
    """All reviewed boxes of the frame, through the recording."""
    page.wait_for_timeout(SETTLED_MS)
    page.keyboard.press("j")
    page.get_by_test_id("follow").locator("xpath=self::*[not(@data-state='running')]").wait_for()
    page.get_by_test_id("ortho-side").locator("rect.line").wait_for()
    wait_for_3d(page)
    keep(page, "guide_follow")
    click(page, "follow-close")


def accept_all(page: Page) -> None:
    """Reviews all proposals with the space bar."""
    project = page.url.split("#")[0] + "api/projects/room"
    while page.request.get(project).json()["labels_by_state"].get("proposed"):
        if page.get_by_test_id("queue-item").count():
            page.keyboard.press("Space")
        page.wait_for_timeout(150)


def select_first(page: Page) -> None:
    """The most doubtful proposal."""
    click(page, "queue-item")
    page.get_by_test_id("ortho-side").locator("rect.line").wait_for()
    wait_for_3d(page)


def train(page: Page) -> None:
    """Both detectors; "Learn while I label" is switched on while they are trained."""
    click(page, "mode-train")
    page.get_by_text("Settings", exact=True).click()
    page.get_by_test_id("train-minutes").fill(str(MINUTES))
    page.get_by_text("Settings", exact=True).click()
    click(page, "train-start")
    page.get_by_test_id("curves-quality").locator(".main-svg").first.wait_for()
    with page.expect_response("**/models/learning"):
        page.get_by_test_id("learn-switch").check()
    page.locator('[data-testid="job-train-text"]', has_text="train the view detector").wait_for()
    keep(page, "guide_train")
    page.get_by_test_id("learn-switch").uncheck()
    page.locator('[data-testid="train-start"]:not([disabled])').wait_for()


def propose(page: Page) -> None:
    """Boxes for the whole recording."""
    page.locator('[data-testid="propose-start"]:not([disabled])').click()
    page.get_by_test_id("review-proposals").wait_for()
    page.locator('[data-testid="propose-start"]:not([disabled])').wait_for()
    page.get_by_test_id("propose-form").scroll_into_view_if_needed()
    keep(page, "guide_propose")


def check(page: Page) -> None:
    """Suspicious labels."""
    click(page, "mode-checks")
    page.get_by_test_id("checks-note").get_by_text("checked.").wait_for()
    keep(page, "guide_check")


def export(page: Page) -> None:
    """A dataset in KITTI's format."""
    click(page, "mode-export")
    page.get_by_test_id("export-format").select_option("kitti")
    page.get_by_test_id("export-divide").check()
    click(page, "export-start")
    page.get_by_test_id("download").wait_for()
    keep(page, "guide_export")
