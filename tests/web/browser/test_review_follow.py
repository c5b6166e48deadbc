"""Review in a real browser: reviewed boxes are followed through the recording."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from review_desk import Desk

from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, WriteContext
from annotator.rcv.follow_object import Followed, FollowStop
from annotator.recordings import open_recording
from annotator.types import Box2D, Proposal, Quality, ReviewState, Source, Truth
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.follow_objects import Follower

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


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
    page.goto(f"/#/{desk.name}/review/{frame.id}?uid={uid}")
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
    expect(page.get_by_test_id("track-tick")).to_have_count(5)
    expect(page.get_by_test_id("follow-stop")).to_be_hidden()
    # all of it is one action
    desk.press("Control+z")
    expect(page.get_by_text("Undone:")).to_be_visible()
    expect(page.get_by_test_id("follow")).to_be_hidden()
    for frame in project.frames.of()[1:]:
        assert [label for label in project.labels.of_frame(frame.id) if label.track_id == truth.track_id] == []

    # on the contact sheet, one click accepts what is before a wrong box and opens it
    show(desk, 0, uid)
    desk.press("v")
    following_gate.release(4)
    expect(page.get_by_test_id("track-tick")).to_have_count(5)
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
    desk.press("Shift+L")
    expect(page.get_by_test_id("follow-title")).to_have_text("Following backward with the project's detector")
    following_gate.release(3)
    expect(page.get_by_test_id("frame-position")).to_have_text("4 / 5")
    expect(page.get_by_test_id("followed")).to_have_count(3)
    page.get_by_test_id("follow-stop").click()
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
    expect(go).to_contain_text(f"{frames[3].key} →")
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
