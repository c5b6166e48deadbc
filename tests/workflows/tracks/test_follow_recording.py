"""Following reviewed boxes through a recording: right boxes, honest stops, one action that can be undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Lock

import pytest

from annotator.cli.main import main
from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, Project, StoredFrame, WriteContext
from annotator.project.event_types import FrameFinalised
from annotator.types import Box2D, BoxKind, Detector, Image, Label, ReviewState, Source, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import Detectors
from annotator.workflows.tracks.follow_recording import follow_recording
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

ANN = "ann"


@pytest.fixture
def view(knowing: Callable[..., Detectors]) -> ReadyDetector:
    return ReadyDetector(knowing("people").view, BoxKind.BOX, Lock())


class Blind:
    """A view detector that finds nothing."""

    labels, fingerprint = ("person",), "blind"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [[] for _ in images]


def blind() -> ReadyDetector:
    detector: Detector = Blind()
    return ReadyDetector(detector, BoxKind.BOX, Lock())


def accept_truth(project: Project, frame: StoredFrame, truths: Sequence[Truth]) -> None:
    """Creates accepted labels of true boxes with their true tracks."""
    context = WriteContext(project.frames.get(frame.id).revision, ANN)
    project.labels.create(frame.id, [NewLabel(t.label, t.box, track_id=t.track_id) for t in truths], context)


def recording_of(project: Project) -> int:
    return project.recordings.all()[0].id


def labels_of(project: Project, index: int) -> list[Label]:
    return list(project.labels.of_frame(project.frames.of()[index].id))


def test_reviewed_boxes_are_followed_to_the_end(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0])
    seen: list[tuple[int, int]] = []
    done = follow_recording(people, recording_of(people), view, ANN, progress=lambda k, n: seen.append((k, n)))
    assert len(done.tracks) == len(truths[0])
    assert seen == [(k, len(truths[0])) for k in range(1, len(truths[0]) + 1)]
    for index in range(1, len(frames)):
        labels = labels_of(people, index)
        assert {label.state for label in labels} <= {ReviewState.PROPOSED}
        for label in labels:
            truth = next(t for t in truths[index] if t.track_id == label.track_id)
            assert iou_3d(label.box, truth.box) > 0.7
    followed = sum(track.boxes for track in done.tracks)
    assert followed == sum(len(labels_of(people, index)) for index in range(1, len(frames)))
    assert followed >= 0.8 * sum(map(len, truths[1:]))
    people.history.undo(ANN)
    assert [labels_of(people, index) for index in range(1, len(frames))] == [[]] * (len(frames) - 1)


def test_a_track_is_followed_backward_and_between_its_reviewed_boxes(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    track = truths[2][0].track_id
    chosen = [[t for t in of_frame if t.track_id == track] for of_frame in truths]
    accept_truth(people, frames[2], chosen[2])
    done = follow_recording(people, recording_of(people), view, ANN, forward=False, backward=True, tracks=[track])
    assert {index for index in range(5) if labels_of(people, index)} == {0, 1, 2}
    people.history.undo(ANN)
    accept_truth(people, frames[4], chosen[4])
    done = follow_recording(people, recording_of(people), view, ANN, tracks=[track])
    assert {index for index in range(5) if labels_of(people, index)} == {2, 3, 4}
    (label,) = labels_of(people, 3)
    assert iou_3d(label.box, chosen[3][0].box) > 0.7
    assert (done.tracks[0].track_id, done.tracks[0].boxes, done.tracks[0].stops) == (track, 1, ())


def test_a_lost_object_is_reported_and_stores_nothing(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    with pytest.raises(ConfigError, match="there is no reviewed box to follow"):
        follow_recording(people, recording_of(people), blind(), ANN)
    accept_truth(people, frames[0], truths[0][:1])
    with pytest.raises(ConfigError, match=f"nothing was proposed; frame {frames[1].key}: lost"):
        follow_recording(people, recording_of(people), blind(), ANN)
    with pytest.raises(ConfigError, match="track 99 has no reviewed box to follow"):
        follow_recording(people, recording_of(people), blind(), ANN, tracks=[99])
    assert labels_of(people, 1) == []


def test_reviewed_boxes_and_finalised_frames_stay(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])
    people.log.append(frames[1].id, [FrameFinalised()], WriteContext(frames[1].revision, ANN, Source.MANUAL))
    follow_recording(people, recording_of(people), view, ANN)
    assert labels_of(people, 1) == []
    assert len(labels_of(people, 2)) == 1


def test_the_command_says_what_it_did(
    people: Project,
    truths: list[list[Truth]],
    view: ReadyDetector,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("annotator.cli.follow.require_view", lambda _: view)
    accept_truth(people, people.frames.of()[0], truths[0][:1])
    name = people.recordings.all()[0].name
    assert main(["follow", people.path.name, name, "--projects", str(people.path.parent)]) == 0
    assert f"track {truths[0][0].track_id} (person): 4 boxes proposed" in capsys.readouterr().out
