"""Boxes between the key frames of a track: those where somebody has reviewed its box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame
from annotator.tracking.interpolate import between
from annotator.types import Label
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.types.tracks import MOST_TRACK
from annotator.workflows.frames import FrameSource
from annotator.workflows.tracks.place import Wanted, part_of, proposing
from annotator.workflows.tracks.snap import Snap
from annotator.workflows.tracks.times import times_of


@dataclass(frozen=True)
class Interpolated:
    """What was filled in.

    Attributes:
        track_id: of the track.
        filled: ids of the frames that have a new proposal, and the receipt of each.
        finalised: frames that were left alone because they are finalised.
        covered: frames that were left alone because somebody has reviewed or rejected a box there.
    """

    track_id: int
    filled: tuple[tuple[int, Receipt], ...]
    finalised: int
    covered: int


@dataclass(frozen=True, eq=False)
class _Key:
    """A key frame: its place among the frames of the recording, and its box."""

    place: int
    label: Label


def interpolate(
    project: Project,
    recording_id: int,
    track_id: int,
    author: str,
    *,
    first: str | None = None,
    last: str | None = None,
    snap: Snap | None = None,
    effort: Effort | None = None,
) -> Interpolated:
    """Proposes boxes of a track in the frames between its key frames, as one action.

    Centre, size and rotation change evenly from one key frame to the next, by the frames' times where they are known.
    Nothing that somebody has reviewed changes; open proposals of the same object give way.

    Args:
        author: who asks for it, and can undo it.
        first, last: keys of two key frames, the earlier one first; None = from the first, up to the last one.
        snap: fits every new box to its frame's points.
        effort: what asking for it has cost.

    Raises:
        NotFoundError: no such recording, or frame.
        ConfigError: no track id, fewer than two key frames, a named frame that is none, or nothing to fill.
        StaleRevisionError: somebody has changed one of the frames meanwhile.
        RecordingError, FrameError: a frame that `snap` needs cannot be read.
    """
    if abs(track_id) > MOST_TRACK:
        raise ConfigError(f"track ids are at most {MOST_TRACK}, not {track_id:.6g}; give the id of a track")
    recording = project.recordings.get(recording_id)
    if not recording.is_sequence:
        raise ConfigError(f"the frames of {recording.name} do not follow each other in time; it has no tracks")
    frames = [frame for frame in project.frames.of([recording_id]) if frame.index is not None]
    keys = _chosen(_keys(project, frames, recording_id, track_id), frames, track_id, first, last)
    times = times_of(FrameSource(project).recording(recording_id), frames).tolist()
    parts: list[FramePart] = []
    finalised = covered = 0
    for before, after in pairwise(keys):
        inside = range(before.place + 1, after.place)
        ends = (times[before.place], times[after.place])
        boxes = between(before.label.box, after.label.box, *ends, [times[place] for place in inside])
        for frame, box in zip(frames[before.place + 1 : after.place], boxes, strict=True):
            if frame.finalised:
                finalised += 1
                continue
            fitted = box if snap is None else snap(frame, box, before.label.label)
            payloads = proposing(project, frame, [Wanted(before.label.label, fitted, track_id)])
            covered += not payloads
            if payloads:
                parts.append(part_of(frame, payloads, author, None if parts else effort))
    if not parts:
        why = f" ({finalised} finalised, {covered} reviewed or rejected)" if finalised or covered else ""
        raise ConfigError(f"there is no frame to fill between the key frames of track {track_id}{why}")
    receipts = project.log.append_to_frames(parts)
    filled = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
    return Interpolated(track_id, filled, finalised, covered)


def interpolate_back(
    project: Project,
    frame_id: int,
    uid: str,
    revision: int,
    author: str,
    *,
    snap: Snap | None = None,
    effort: Effort | None = None,
) -> Interpolated:
    """As `interpolate`, from the key frame before a reviewed label to the label.

    Args:
        revision: of the label's frame, as the operator has seen it.

    Raises:
        StaleRevisionError: somebody has changed the frame since.
        ConfigError: the label is not reviewed, has no track, or is the first of it; or as `interpolate`.
        NotFoundError, RecordingError, FrameError: as `interpolate`; or no such label.
    """
    frame, label = project.frames.get(frame_id), project.labels.get(uid).label
    if frame.revision != revision:
        raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
    if label.state not in REVIEWED:
        raise ConfigError("only reviewed boxes are key frames; accept the box first")
    if label.track_id is None:
        raise ConfigError("the box belongs to no track; give it the track id of the earlier box first")
    frames = [each for each in project.frames.of([frame.recording_id]) if each.index is not None]
    keys = _keys(project, frames, frame.recording_id, label.track_id)
    earlier = [frames[key.place].key for key in keys if (frames[key.place].index or 0) < (frame.index or 0)]
    if not earlier:
        raise ConfigError(f"track {label.track_id} has no reviewed box in an earlier frame")
    return interpolate(
        project,
        frame.recording_id,
        label.track_id,
        author,
        first=earlier[-1],
        last=frame.key,
        snap=snap,
        effort=effort,
    )


def _keys(project: Project, frames: Sequence[StoredFrame], recording_id: int, track_id: int) -> list[_Key]:
    """The key frames of a track, in order.

    Raises:
        ConfigError: two reviewed boxes of the track in one frame.
    """
    places = {frame.id: place for place, frame in enumerate(frames)}
    found: dict[int, _Key] = {}
    for stored in project.labels.select(states=REVIEWED, recordings=[recording_id], tracks=[track_id]):
        if stored.frame_id not in places:
            continue
        place = places[stored.frame_id]
        if place in found:
            raise ConfigError(
                f"frame {frames[place].key} has two reviewed boxes of track {track_id}; give one of them another track"
            )
        found[place] = _Key(place, stored.label)
    return [found[place] for place in sorted(found)]


def _chosen(
    keys: list[_Key], frames: Sequence[StoredFrame], track_id: int, first: str | None, last: str | None
) -> list[_Key]:
    """Those from one key to another.

    Raises:
        NotFoundError, ConfigError: as `interpolate`.
    """
    by_key = {frame.key: place for place, frame in enumerate(frames)}
    ends = []
    for name in (first, last):
        if name is not None and name not in by_key:
            raise NotFoundError(f"the recording has no frame {name!r}")
        if name is not None and by_key[name] not in {key.place for key in keys}:
            raise ConfigError(f"frame {name} has no reviewed box of track {track_id}")
        ends.append(None if name is None else by_key[name])
    low = 0 if ends[0] is None else ends[0]
    high = len(frames) if ends[1] is None else ends[1]
    chosen = [key for key in keys if low <= key.place <= high]
    if len(chosen) < 2:
        raise ConfigError(
            f"track {track_id} has {len(chosen)} reviewed boxes there; two are needed to fill between them"
        )
    return chosen
