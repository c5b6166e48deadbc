"""Review in a real browser: tracks are continued, filled, followed through the recording and stepped through."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import Desk
from live_server import PATIENCE_S

from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, WriteContext
from annotator.project.changes import LabelChanged
from annotator.rcv.follow_object import Followed, FollowStop
from annotator.recordings import open_recording
from annotator.types import Box2D, Label, Proposal, Quality, ReviewState, Source, Truth
from annotator.types.messages import amount
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.follow_objects import Follower
from annotator.workflows.tracks.refit_run import MIN_IOU

if TYPE_CHECKING:
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api").expect


TURNED = re.compile(r"turned by 1[78]\d°")


def of_track(desk: Desk, frame: int, track_id: int = 7) -> list[Label]:
    return [label for label in desk.project.labels.of_frame(frame) if label.track_id == track_id]


def has_boxes(page: Page, frames: int) -> None:
    """Waits until the timeline shows the selected track in so many frames."""
    lanes = page.get_by_test_id("timeline-lanes").locator("canvas")
    expect(lanes).to_have_attribute("aria-label", re.compile(rf": in {frames} frames?, "))


def test_a_track_is_continued_filled_and_stepped_through(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    frames = [stored.id for stored in project.frames.of()]
    page.goto(f"/#/{desk.name}/annotate/{frames[0]}")
    expect(page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    desk.settled()
    uid = desk.uid
    page.get_by_test_id("field-track").fill("7")
    page.get_by_test_id("field-track").press("Enter")
    wait_for(lambda: desk.label.track_id == 7)
    assert desk.label.state is ReviewState.PROPOSED, "setting the track is not a review of the box"
    desk.settled()
    has_boxes(page, 1)
    name = page.locator(".track .ellipsis")
    expect(name).to_have_text("Track 7")
    assert name.evaluate("one => one.scrollWidth <= one.clientWidth")

    desk.press("Space")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.ACCEPTED)
    # the page has selected the next proposal
    page.locator(f'[data-testid="frame-box"][aria-current="true"]:not([data-uid="{uid}"])').wait_for()
    desk.settled()
    page.locator(f'[data-testid="frame-box"][data-uid="{uid}"]').click()
    desk.settled()
    page.locator("body").click(position={"x": 2, "y": 2})

    # the reviewed box is copied, and the page opens that frame
    desk.press("Shift+C")
    expect(page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    (copied,) = of_track(desk, frames[1])
    assert copied.state is ReviewState.PROPOSED
    assert np.array_equal(copied.box.size_m, project.labels.get(uid).label.box.size_m)
    # and selects the copy
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{copied.uid}"]').wait_for()
    desk.settled()
    has_boxes(page, 2)
    desk.press("Shift+P")
    expect(page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    assert desk.uid == uid
    desk.press("Shift+N")
    expect(page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    assert desk.uid == copied.uid
    desk.settled()
    # turned round beside its neighbour, it is marked at once: in the list, in the views, on the image, at the number
    jumps, on_pictures = page.get_by_test_id("heading-jump"), page.get_by_test_id("wrong-heading")
    expect(jumps).to_have_count(0)
    desk.press("f")
    expect(jumps).to_have_count(1)
    expect(on_pictures).to_have_count(4)
    expect(page.locator(".number-field .bad")).to_have_text(TURNED)
    expect(page.get_by_test_id("editor-tag").filter(has_text=TURNED)).to_have_count(1)
    wait_for(lambda: of_track(desk, frames[1])[0].box.rotation[:, 0] @ copied.box.rotation[:, 0] < -0.999)
    (turned,) = of_track(desk, frames[1])
    np.testing.assert_allclose(turned.box.size_m, copied.box.size_m, atol=1e-9)
    desk.settled()
    desk.press("f")
    expect(jumps).to_have_count(0)
    expect(on_pictures).to_have_count(0)
    desk.settled()
    desk.press("Control+z", "Control+z")
    wait_for(lambda: of_track(desk, frames[1])[0].state is ReviewState.PROPOSED)
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: not of_track(desk, frames[1]))

    # another operator reviews the object in frame 4, from which the frames between are filled
    first = project.labels.get(uid).label
    context = WriteContext(project.frames.get(frames[3]).revision, "bob")
    project.labels.create(frames[3], [NewLabel(first.label, first.box, track_id=7)], context)
    page.goto(f"/#/{desk.name}/annotate/{frames[3]}")
    expect(page.get_by_test_id("frame-position")).to_have_text("4 / 5")
    has_boxes(page, 2)
    desk.settled()
    desk.press("i")
    expect(page.get_by_test_id("track-count")).to_have_text("This proposes 2 boxes in place of 2 other proposals.")
    page.get_by_test_id("track-refit").check()
    page.keyboard.press("Enter")
    has_boxes(page, 4)
    # they are fitted in the background
    expect(page.get_by_test_id("follow-title")).to_have_text("Fitted filled boxes by points")
    expect(page.get_by_test_id("followed")).to_have_count(1)
    for frame in frames[1:3]:
        (filled,) = of_track(desk, frame)
        assert filled.state is ReviewState.PROPOSED
        assert iou_3d(filled.box, first.box) > MIN_IOU
    page.get_by_test_id("color-by-track").check()
    page.get_by_test_id("timeline-strip").get_by_role("button").nth(1).click()
    expect(page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: not of_track(desk, frames[1]) and not of_track(desk, frames[2]))
    expect(page.get_by_test_id("follow")).to_be_hidden()


def test_the_operator_chooses_which_of_two_boxes_of_a_track_stays(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    frame = project.frames.of()[0].id
    one, two, *_ = (label.uid for label in project.labels.of_frame(frame))
    project.log.append(
        frame, [LabelChanged(uid=one, track_id=7)], WriteContext(project.frames.get(frame).revision, "bob")
    )
    page.goto(f"/#/{desk.name}/annotate/{frame}?uid={two}")
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{two}"]').wait_for()
    desk.settled()

    def enter_track(choice: str) -> None:
        page.get_by_test_id("field-track").fill("7")
        page.get_by_test_id("field-track").press("Enter")
        page.get_by_test_id(choice).click()
        expect(page.get_by_test_id("which-stays")).to_have_count(0)
        desk.settled()

    enter_track("dialog-neither")
    expect(page.get_by_test_id("field-track")).to_have_value("")
    tracks = {label.uid: label.track_id for label in project.labels.of_frame(frame)}
    assert (tracks[one], tracks[two]) == (7, None)
    enter_track("dialog-this")
    assert [label.uid for label in of_track(desk, frame)] == [two]
    page.locator("body").click(position={"x": 2, "y": 2})
    desk.press("Control+z")
    wait_for(lambda: [label.uid for label in of_track(desk, frame)] == [one])
    # until the page has heard of it, the track that is typed is the one that is there
    page.locator(f'[data-testid="frame-box"][data-uid="{one}"]').wait_for()
    page.locator(f'[data-testid="frame-box"][data-uid="{two}"]').click()
    desk.settled()
    enter_track("dialog-other")
    assert [label.uid for label in of_track(desk, frame)] == [one]
    assert two not in {label.uid for label in project.labels.of_frame(frame)}
    # continuing without a reviewed box, or a track, gives a message
    other = next(label.uid for label in project.labels.of_frame(frame) if label.track_id is None)
    page.locator(f'[data-testid="frame-box"][data-uid="{other}"]').click()
    desk.settled()
    desk.press("v")
    expect(page.get_by_text("Select a reviewed box to follow, or accept this one first")).to_be_visible()
    expect(page.get_by_test_id("track-fill")).to_be_hidden()
    desk.press("Shift+N")
    expect(page.get_by_text("This box has no track")).to_be_visible()


def test_wrong_boxes_are_clicked_out_on_the_sheet_and_the_others_accepted(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    frames = project.frames.of()[:3]
    for frame in frames:
        uid = next(label.uid for label in project.labels.of_frame(frame.id))
        project.log.append(frame.id, [LabelChanged(uid=uid, track_id=7)], WriteContext(frame.revision, "Ada"))
    first, wrong, last = (of_track(desk, frame.id)[0].uid for frame in frames)
    tiles = page.get_by_test_id("sheet-box")

    # the pictures are asked for before the sheet is opened
    with page.expect_request(lambda request: request.url.endswith("/tracks/7/sheet")):
        page.goto(f"/#/{desk.name}/annotate/{frames[0].id}?uid={first}")
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{first}"]').wait_for()
    desk.settled()
    desk.press("s")
    expect(tiles).to_have_count(3)
    page.wait_for_function("() => [...document.querySelectorAll('.sheet img')].every((image) => image.naturalWidth)")
    # from the second one to the end, and the last one again
    tiles.nth(1).click(modifiers=["Shift"])
    expect(tiles.nth(2)).to_have_attribute("aria-pressed", "true")
    tiles.nth(2).click()
    expect(tiles.nth(2)).to_have_attribute("aria-pressed", "false")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("sheet")).to_have_count(0)
    # the wrong one is opened
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{wrong}"]').wait_for()
    states = [project.labels.get(uid).label.state for uid in (first, wrong, last)]
    assert states == [ReviewState.ACCEPTED, ReviewState.PROPOSED, ReviewState.ACCEPTED]
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: project.labels.get(last).label.state is ReviewState.PROPOSED)
    assert project.labels.get(first).label.state is ReviewState.PROPOSED


def test_a_frames_boxes_are_accepted_together_and_later_ones_move_with_a_corrected_one(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    first, second = (frame.id for frame in project.frames.of()[:2])
    uids = [label.uid for label in project.labels.of_frame(first)]
    assert len(uids) > 1
    page.locator(f'[data-testid="queue-item"][data-uid="{uids[0]}"]').click()
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{uids[0]}"]').wait_for()
    expect(page.locator(".small-views")).to_have_count(len(uids))
    desk.settled()
    desk.press("Shift+Space")
    wait_for(lambda: all(label.state is ReviewState.ACCEPTED for label in project.labels.of_frame(first)))
    # the next box of the queue is in another frame
    page.locator(f'[data-testid="frame-box"][aria-current="true"]:not([data-uid="{uids[0]}"])').wait_for()
    assert all(label.state is ReviewState.PROPOSED for label in project.labels.of_frame(second))
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: all(label.state is ReviewState.PROPOSED for label in project.labels.of_frame(first)))
    desk.settled()

    # what was found after a wrong box is as wrong, and is corrected with it
    frames = project.frames.of()[:3]
    for frame in frames:
        uid = project.labels.of_frame(frame.id)[0].uid
        project.log.append(frame.id, [LabelChanged(uid=uid, track_id=7)], WriteContext(frame.revision, "Ada"))
    before = [of_track(desk, frame.id)[0].box.size_m[0] for frame in frames]
    uid = of_track(desk, frames[0].id)[0].uid
    page.goto("about:blank")
    page.goto(f"/#/{desk.name}/annotate/{frames[0].id}?uid={uid}")
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{uid}"]').wait_for()
    desk.settled()
    page.get_by_test_id("field-size-length").fill(str(round(before[0] + 0.5, 6)))
    page.get_by_test_id("field-size-length").press("Enter")
    wait_for(lambda: desk.label.state is ReviewState.EDITED)
    later = [of_track(desk, frame.id)[0] for frame in frames[1:]]
    np.testing.assert_allclose([label.box.size_m[0] for label in later], np.add(before[1:], 0.5), atol=1e-4)
    assert all(label.state is ReviewState.PROPOSED for label in later)
    desk.settled()


def test_a_whole_track_changes_once_the_page_has_told_what_that_changes(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    project.configure(classes=("person", "robot"))
    frames = [frame.id for frame in project.frames.of()]
    uids = []
    for place, frame in enumerate(frames):
        state = ReviewState.ACCEPTED if place in (0, 4) else ReviewState.PROPOSED
        new = NewLabel("person", truths(desk, place)[0].box, track_id=7, state=state)
        uids += project.labels.create(frame, [new], WriteContext(project.frames.get(frame).revision, "Ada")).uids

    def numbers() -> list[int | None]:
        return [project.labels.get(uid).label.track_id for uid in uids]

    def answer(told: str) -> None:
        expect(page.get_by_test_id("track-count")).to_have_text(f"This {told}.")
        page.keyboard.press("Enter")
        expect(page.get_by_test_id("track-operation")).to_have_count(0)
        desk.settled()

    def undo(is_done: Callable[[], bool]) -> None:
        desk.press("Control+z")
        wait_for(is_done)
        desk.settled()

    show(desk, 2, uids[2])
    desk.press("e")
    answer("changes 3 boxes, 1 of them reviewed; their number is 8, a new one")
    assert numbers() == [7, 7, 8, 8, 8]
    expect(page.get_by_test_id("field-track")).to_have_value("8")
    # both are one object after all
    desk.press("Shift+M")
    expect(page.get_by_test_id("track-other")).to_have_value("7")
    answer("changes 3 boxes, 1 of them reviewed; their number is 7, that of 2 other boxes")
    assert numbers() == [7] * 5
    undo(lambda: numbers() == [7, 7, 8, 8, 8])
    undo(lambda: numbers() == [7] * 5)
    expect(page.get_by_test_id("frame-position")).to_have_text("3 / 5")

    desk.press("Shift+2")
    answer("changes 5 boxes, 2 of them reviewed")
    assert {project.labels.get(uid).label.label for uid in uids} == {"robot"}
    undo(lambda: {project.labels.get(uid).label.label for uid in uids} == {"person"})

    desk.press("Shift+Delete")
    expect(page.get_by_test_id("track-count")).to_have_text("This deletes 3 boxes, 1 of them reviewed.")
    page.keyboard.press("Escape")
    assert numbers() == [7] * 5

    # a corrected box takes those along that are not reviewed, up to the reviewed ones
    before = [project.labels.get(uid).label.box.center_m[0] for uid in uids]
    page.get_by_test_id("field-center-x").fill(str(round(before[2] + 2.0, 6)))
    page.get_by_test_id("field-center-x").press("Enter")
    wait_for(lambda: project.labels.get(uids[2]).label.box.center_m[0] != before[2])
    after = [project.labels.get(uid).label.box.center_m[0] for uid in uids]
    np.testing.assert_array_equal(np.abs(np.subtract(after, before)) > 1e-6, [False, True, True, True, False])
    page.locator("body").click(position={"x": 2, "y": 2})
    undo(lambda: [project.labels.get(uid).label.box.center_m[0] for uid in uids] == before)

    # one that stands still has one box, which the frames that see it show, and change, together
    with project.store.write() as connection:
        connection.exec_driver_sql("UPDATE frames SET world = ?", (json.dumps(np.eye(4).tolist()),))
    show(desk, 2, uids[2])
    desk.press("a")
    unchanged = "unchanged: 2 where a box is reviewed or rejected already"
    answer(f"changes 1 box and deletes 2 boxes, none of them reviewed; {unchanged}")
    expect(page.get_by_test_id("track-still")).to_have_attribute("aria-pressed", "true")
    lanes = page.get_by_test_id("timeline-lanes").locator("canvas")
    wait_for(lambda: not project.stills.unsighted(1))
    shown = project.labels.along(1, tracks=[7])
    also = next(each.frame_id for each in shown if each.still and each.frame_id != frames[2])
    number = len(shown)
    expect(lanes).to_have_attribute("aria-label", re.compile(rf"person 7 \(still\): in {number} frames, {number} re"))
    page.get_by_test_id("track-here").check()
    desk.press("Delete")
    wait_for(lambda: [label.state for label in of_track(desk, frames[2])] == [ReviewState.REJECTED])
    assert [label.state for label in of_track(desk, also)] == [ReviewState.ACCEPTED]
    undo(lambda: [label.state for label in of_track(desk, frames[2])] == [ReviewState.ACCEPTED])
    page.locator('[data-testid="frame-box"][data-state="accepted"]').click()
    desk.press("a")
    answer(f"proposes {amount(len([each for each in shown if each.still]) - 1, 'box')}")
    assert [label.state for label in of_track(desk, also)] == [ReviewState.PROPOSED]


def truths(desk: Desk, index: int) -> list[Truth]:
    recording = open_recording(desk.project.recordings.all()[0].path)
    return list(load_truth(recording, index, recording.frame(index)))


def accept_truth(desk: Desk, index: int, objects: int = 1) -> list[str]:
    """Accepts the true boxes of a frame with their tracks, in place of its proposals; returns their labels."""
    frame = desk.project.frames.of()[index]
    for label in desk.project.labels.of_frame(frame.id):
        frame = desk.project.frames.get(frame.id)
        desk.project.labels.delete(frame.id, label.uid, WriteContext(frame.revision, "bob"))
    new = [NewLabel(t.label, t.box, track_id=t.track_id) for t in truths(desk, index)[:objects]]
    context = WriteContext(desk.project.frames.get(frame.id).revision, "bob")
    return list(desk.project.labels.create(frame.id, new, context).uids)


def show(desk: Desk, index: int, uid: str) -> None:
    """Opens a frame of the project in Review, with a label selected."""
    page, frame = desk.page, desk.project.frames.of()[index]
    page.goto(f"/#/{desk.name}/annotate/{frame.id}?uid={uid}")
    expect(page.get_by_test_id("frame-position")).to_have_text(f"{index + 1} / 5")
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{uid}"]').wait_for()
    desk.settled()


@pytest.mark.usefixtures("following_view")
def test_a_reviewed_box_is_followed_and_the_page_goes_to_the_first_new_box(
    desk: Desk, wait_for, following_gate: threading.Semaphore
) -> None:
    page, project = desk.page, desk.project
    (uid,) = accept_truth(desk, 0)
    (truth,) = truths(desk, 0)[:1]
    show(desk, 0, uid)
    desk.press("v")
    title = page.get_by_test_id("follow-title")
    expect(title).to_have_text("Following forward with the project's detector")
    following_gate.release()
    # the first box is shown while following goes on
    expect(page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    desk.settled()
    assert desk.label.state is ReviewState.PROPOSED
    assert desk.label.track_id == truth.track_id
    assert iou_3d(desk.label.box, truths(desk, 1)[0].box) > 0.7
    expect(page.get_by_test_id("follow-stop")).to_be_visible()
    expect(page.get_by_test_id("followed")).to_have_text(f"Track {truth.track_id} (person): 1 box")
    following_gate.release(3)
    expect(title).to_have_text("Followed forward with the project's detector")
    expect(page.get_by_test_id("followed")).to_have_text(
        f"Track {truth.track_id} (person): 4 boxes, to the recording's last frame"
    )
    has_boxes(page, 5)
    expect(page.get_by_test_id("follow-stop")).to_be_hidden()
    # all of it is one action
    desk.press("Control+z")
    expect(page.get_by_text("Undone:")).to_be_visible()
    expect(page.get_by_test_id("follow")).to_be_hidden()
    for frame in project.frames.of()[1:]:
        assert [label for label in project.labels.of_frame(frame.id) if label.track_id == truth.track_id] == []

    # an operator on the way to another frame is not taken back
    show(desk, 0, uid)
    desk.press("v")
    expect(title).to_have_text("Following forward with the project's detector")
    held, later = [], project.frames.of()[3].id
    page.route(f"**/frames/{later}", lambda route: held.append(route))
    with page.expect_request(f"**/frames/{later}"):
        page.evaluate("(hash) => (location.hash = hash)", f"#/{desk.name}/annotate/{later}")
    following_gate.release(4)
    expect(page.get_by_test_id("followed")).to_contain_text("4 boxes")
    held[0].continue_()
    expect(page.get_by_test_id("frame-position")).to_have_text("4 / 5")
    page.unroute(f"**/frames/{later}")
    # undoing shows what is undone
    desk.press("Control+z")
    expect(page.get_by_test_id("frame-position")).to_have_text("2 / 5")

    # on the contact sheet, one click accepts what is before a wrong box and opens it
    show(desk, 0, uid)
    desk.press("v")
    following_gate.release(4)
    has_boxes(page, 5)
    # keys wait until it is there
    expect(page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    desk.settled()
    desk.press("s")
    tiles = page.get_by_test_id("sheet-box")
    expect(tiles).to_have_count(5)
    tiles.nth(2).click(modifiers=["Control"])
    expect(page.get_by_test_id("frame-position")).to_have_text("3 / 5")

    def states() -> list[ReviewState]:
        labels = [label for frame in project.frames.of() for label in project.labels.of_frame(frame.id)]
        return [label.state for label in labels if label.track_id == truth.track_id]

    def correct_and_follow() -> None:
        desk.settled()
        page.get_by_test_id("field-size-length").fill("0.6")
        desk.press("Enter")
        desk.settled()
        desk.press("v")
        following_gate.release()

    open_, accepted = ReviewState.PROPOSED, ReviewState.ACCEPTED
    assert states() == [accepted] * 2 + [open_] * 3
    # once it is corrected and followed, the sheet comes back, and shows each new box
    correct_and_follow()
    note = page.get_by_test_id("sheet-note")
    expect(note).to_contain_text("still being followed")
    page.keyboard.press("Enter")
    expect(page.locator("dialog .error-box")).to_contain_text("Wait for the last boxes")
    # "all from here are wrong" also holds for what is found later
    tiles.nth(3).click(modifiers=["Shift"])
    following_gate.release()
    expect(note).to_contain_text("2 proposals of 5 boxes. Top")
    expect(tiles.nth(4)).to_have_attribute("aria-pressed", "true")
    tiles.nth(3).click(modifiers=["Shift"])
    page.wait_for_function("() => [...document.querySelectorAll('.sheet img')].every((image) => image.naturalWidth)")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("sheet")).to_have_count(0)
    wait_for(lambda: states() == [accepted] * 2 + [ReviewState.EDITED] + [accepted] * 2)
    desk.settled()


@pytest.mark.usefixtures("following_view")
def test_boxes_are_followed_backward_stopped_or_lost_and_a_run_is_forgotten_with_the_server(
    desk: Desk, following_gate: threading.Semaphore, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = desk.page
    uid, *_ = accept_truth(desk, 4, 3)
    show(desk, 4, uid)
    desk.press("Shift+J")
    expect(page.get_by_test_id("follow-title")).to_have_text("Following backward with the project's detector")
    following_gate.release(3)
    expect(page.get_by_test_id("frame-position")).to_have_text("4 / 5")
    expect(page.get_by_test_id("followed")).to_have_count(3)
    (running,) = desk.live.context.follow_runs._runs[desk.project].values()
    page.get_by_test_id("follow-stop").click()
    # the run goes on only when the server knows that it is to stop
    assert running.stop.wait(PATIENCE_S)
    following_gate.release(3)
    expect(page.get_by_test_id("follow-title")).to_have_text("Stopped backward with the project's detector")
    # none of them has come to the first frame
    expect(page.get_by_test_id("followed").filter(has_text=", to ")).to_have_count(0)
    page.get_by_test_id("follow-close").click()
    expect(page.get_by_test_id("follow")).to_be_hidden()
    page.reload()
    expect(page.get_by_test_id("frame-position")).to_have_text("4 / 5")

    # a lost object is shown where it was lost
    step, frames = Follower.step, desk.project.frames.of()

    def lose(follower: Follower, moment: Any) -> Any:
        return step(follower, moment) if moment.index < 3 else Followed(None, FollowStop.POINTS)

    monkeypatch.setattr(Follower, "step", lose)
    (uid,) = accept_truth(desk, 0)
    other = Proposal(
        "person", 0.8, truths(desk, 0)[1].box, Box2D("person", 1.0, 2.0, 30.0, 40.0), (), Quality(0.1, 0.9, 0.1)
    )
    frame = desk.project.frames.get(frames[0].id)
    desk.project.proposals.replace(frame.id, [other], WriteContext(frame.revision, "rcv", Source.AUTO))
    show(desk, 0, uid)
    page.get_by_test_id("act-follow").click()
    following_gate.release(4)
    go = page.get_by_test_id("follow-go").first
    expect(go).to_contain_text("4 →")
    expect(go).to_contain_text("too few points are left")
    # what is open in this frame comes before the first new box
    page.locator(f'[data-testid="frame-box"][aria-current="true"]:not([data-uid="{uid}"])').wait_for()
    expect(page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    go.click()
    expect(page.get_by_test_id("frame-position")).to_have_text("4 / 5")
    # a restarted server does not know the run
    desk.live.context.follow_runs._runs.clear()
    # ends all connections; the page connects again
    desk.live.context.hub.close()
    expect(page.get_by_test_id("follow")).to_be_hidden()
