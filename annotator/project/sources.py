"""Proposals from other software, beside our own: each is a row; of those that see one object, the surest is shown."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from annotator.geometry.iou import intersection_volume_pairs, iou_3d_matrix
from annotator.project.audit.making import put_said
from annotator.project.audit.writing import Write
from annotator.project.changes import NewLabel
from annotator.project.classes.attributes import fitting
from annotator.project.classes.values import Values, conflicts, is_open_still, lent, new_values, of_tracks, own_values
from annotator.project.database.store import Store, driver_of
from annotator.project.labels import certainty
from annotator.project.records import OWN
from annotator.project.rows import Row, said_in, said_json, said_with, values_json
from annotator.types import Label, Proposal, ReviewState, Truth
from annotator.types.label import AttributeValue, Said

# Minimum exact 3D IoU at which two boxes count as the same object.
SAME_OBJECT_IOU = 0.5


Staying = TypeVar("Staying", bound=Truth)


def covered_by(proposals: Sequence[Proposal | Label | NewLabel], reviewed: Iterable[Staying]) -> list[Staying | None]:
    """For each proposal, the reviewed label of its class with the greatest 3D IoU, if 0.5 or more."""
    covering: list[Staying | None] = [None] * len(proposals)
    labels = list(reviewed)
    for name in {label.label for label in labels}:
        indices = [index for index, proposal in enumerate(proposals) if proposal.label == name]
        candidates = [label for label in labels if label.label == name]
        if not indices:
            continue
        iou = iou_3d_matrix([proposals[index].box for index in indices], [label.box for label in candidates])
        for index, row in zip(indices, iou, strict=True):
            best = int(np.argmax(row))
            if row[best] >= SAME_OBJECT_IOU:
                covering[index] = candidates[best]
    return covering


def merged(frames: Sequence[Sequence[Said]]) -> list[list[list[int]]]:
    """Of each frame, the places of the boxes of each object, that to show first; two of a source stay apart.

    Boxes of two sources are one object if their exact 3D IoU is 0.5 or more, whatever their classes. The surest box is
    shown. A box without a score counts as sure. If two are equally sure, it is that of the other software, since
    somebody wants to see it; otherwise the earlier one.
    """
    return [_merged(said, same) for said, same in zip(frames, _same_objects(frames), strict=True)]


def _merged(said: Sequence[Said], same: Mapping[int, Mapping[int, float]]) -> list[list[int]]:
    groups: dict[int, list[int]] = {}
    for place in sorted(range(len(said)), key=lambda place: certainty(said[place])):
        source, overlaps = said[place].source, same.get(place, {})
        free = [
            shown
            for shown in (groups if overlaps else ())
            if shown in overlaps and all(said[other].source != source for other in groups[shown])
        ]
        if free:
            groups[max(free, key=lambda shown: overlaps[shown])].append(place)
        else:
            groups[place] = [place]
    return list(groups.values())


def _same_objects(frames: Sequence[Sequence[Said]]) -> list[dict[int, dict[int, float]]]:
    """Of each frame, by the place of a box, the IoU with the boxes of other sources that may see the same object."""
    every = [each for said in frames for each in said]
    found = [defaultdict[int, dict[int, float]](dict) for _ in frames]
    if len({each.source for each in every}) <= 1:
        return [dict(each) for each in found]
    lengths = [len(said) for said in frames]
    starts = np.cumsum([0, *lengths])
    pairs = [np.add(np.triu_indices(length, 1), start) for length, start in zip(lengths, starts[:-1], strict=True)]
    first, second = np.concatenate(pairs, axis=1)
    poses, sizes = np.array([each.box.pose for each in every]), np.array([each.box.size_m for each in every])
    centers, rotations = poses[:, :3, 3], poses[:, :3, :3]
    names = np.unique([each.source for each in every], return_inverse=True)[1]
    reach = np.linalg.norm(sizes, axis=1) / 2
    apart = np.linalg.norm(centers[first] - centers[second], axis=1)
    near = (apart < reach[first] + reach[second]) & (names[first] != names[second])
    first, second = first[near], second[near]
    parts = (values[chosen] for chosen in (first, second) for values in (centers, rotations, sizes))
    shared, volumes = intersection_volume_pairs(*parts), sizes.prod(axis=1)
    iou = shared / (volumes[first] + volumes[second] - shared)
    of_frame = np.searchsorted(starts, first, side="right") - 1
    for a, b, frame, value in zip(first.tolist(), second.tolist(), of_frame.tolist(), iou.tolist(), strict=True):
        if value >= SAME_OBJECT_IOU:
            a, b = a - int(starts[frame]), b - int(starts[frame])
            found[frame][a][b] = found[frame][b][a] = value
    return [dict(each) for each in found]


# --- storing what a source says ---------------------------------------------------------------------------------------

KIND = "proposals_imported"


@dataclass(frozen=True)
class Brought:
    """Result of storing one source's boxes of a frame.

    Attributes:
        is_open: for each of them, False if a reviewed label covers it, so that it is not proposed.
        merged: number of the others that other sources see as well, or our own proposals.
        conflicts: number of their values that another source says otherwise; the surest box's are shown.
    """

    is_open: tuple[bool, ...]
    merged: int
    conflicts: int


Told = tuple[Row, Said]
"""The row of an open proposal, and what its source says in its own words."""


def told(write: Write, source: str, boxes: Sequence[NewLabel]) -> tuple[list[Told], tuple[bool, ...]]:
    """All open proposals of a frame, with new ones of a source in place of its earlier ones; which boxes are such."""
    terms, waiting = write.terms, write.open_proposals()
    staying = [
        Truth(terms.names[row["class_id"]], terms.box(row["box"], write.frame_id))
        for row in _others(write, {row["uid"] for row in waiting})
        if row["behind"] is None and not is_open_still(row, terms)
    ]
    for row in waiting:
        if row["of_source"] == source:
            write.put("labels", row["uid"], None)
    is_open = tuple(cover is None for cover in covered_by(boxes, staying))
    found = [(row, _words(write, row)) for row in waiting if row["of_source"] != source]
    for box, is_new in zip(boxes, is_open, strict=True):
        if is_new:
            more = box.score, box.track_id, box.box_kind, dict(box.attributes), box.file_track_id
            said = Said(source, box.label, box.box, *more)
            found.append((put_said(write, said), said))
    return found, is_open


def agreement(write: Write, source: str, objects: Sequence[Sequence[Said]]) -> tuple[int, int]:
    """The number of a source's boxes that others see as well, and of its values that another one says otherwise."""
    together = sum(len(group) > 1 and any(each.source == source for each in group) for group in objects)
    differing = 0
    for group in objects if write.terms.attributes else ():
        its = [each.attributes for each in group if each.source == source]
        others = [each.attributes for each in group if each.source != source]
        differing += conflicts(write.terms.attributes_of(group[0].label), its, others)
    return together, differing


def regroup(write: Write, waiting: Sequence[Row]) -> None:
    """Shows, of the proposals of a frame that see one object, the surest; the others get behind it."""
    found = [(row, _words(write, row)) for row in waiting]
    (groups,) = merged([[said for _, said in found]])
    show(write, [[found[place] for place in group] for group in groups])


def show(write: Write, groups: Sequence[Sequence[Told]]) -> list[list[Said]]:
    """Stores the objects of a frame, each with the box to show first; returns them, each source in its own words."""
    tracks = _tracks(write, groups)
    attributes = write.terms.attributes
    of_track = of_tracks(write.connection, write.terms, write.frame_id, tracks) if attributes else {}
    for group, track_id in zip(groups, tracks, strict=True):
        (shown, words), *others = group
        columns: Row = {"behind": None, "track_id": track_id}
        if attributes:
            lenders = [said.attributes for _, said in others]
            columns |= _with_values(write, shown, words, lenders, of_track.get(track_id, {}))
        write.put("labels", shown["uid"], shown | columns)
        for row, said in others:
            columns = {"behind": shown["uid"], "track_id": said.track_id}
            if attributes:
                columns |= _values_columns(row, said, said.attributes)
            write.put("labels", row["uid"], row | columns)
    return [[said for _, said in group] for group in groups]


def _others(write: Write, uids: Collection[str]) -> list[Row]:
    return [row for row in (*write.labels(), *write.sightings()) if row["uid"] not in uids]


def _tracks(write: Write, groups: Sequence[Sequence[Told]]) -> list[int | None]:
    """The track of each object: that of ours, else the first one of its sources that has no box in the frame."""
    if all(said.track_id is None for group in groups for _, said in group):
        return [None] * len(groups)
    stay = _others(write, {row["uid"] for group in groups for row, _ in group})
    taken: set[int | None] = {None, *write.hidden_tracks()}
    taken |= {row["track_id"] for row in stay if row["state"] != ReviewState.REJECTED.value and row["behind"] is None}
    taken |= {row["track_id"] for (row, said), *_ in groups if said.source == OWN}
    tracks = list[int | None]()
    for group in groups:
        row, said = group[0]
        free = (each.track_id for _, each in group if each.track_id not in taken)
        tracks.append(row["track_id"] if said.source == OWN else next(free, None))
        taken.add(tracks[-1])
    return tracks


def _words(write: Write, row: Row) -> Said:
    """What the source of an open proposal says, in its own words."""
    said = said_in(row, write.terms.key, write.terms.place(write.frame_id))
    return said if row["said"] is None else replace(said, attributes=own_values(row))


def _with_values(
    write: Write, row: Row, said: Said, lenders: Sequence[Values], of_track: Mapping[str, AttributeValue]
) -> Row:
    """The columns of a shown box with the values of its object: of its sources, else of its track, else the defaults.

    A proposal of ours has them already, unless other sources lend it some.
    """
    of_label = write.terms.attributes_of(said.label)
    borrowed = lent(of_label, said.attributes, lenders)
    if said.source == OWN and not borrowed and row["said"] is None:
        return {}
    values = new_values(of_label, of_track, fitting(of_label, said.attributes) | borrowed)
    return _values_columns(row, said, values)


def _values_columns(row: Row, said: Said, given: Values) -> Row:
    """The columns of a box with values that it is given, which may be others than its source says."""
    text: str | None = row["said"]
    if text is not None or given != said.attributes:
        text = said_with(said_json(row) if text is None else text, said.attributes, given)
    return {"attributes": values_json(given), "said": text}


def source_tracks(store: Store, recording_id: int, source: str) -> tuple[set[int], dict[int, int]]:
    """All track ids of a recording's rig, also of hidden boxes; and those of `source`, by the ids in its files."""
    query = (
        "SELECT track_id, of_source, iif(said IS NULL, track_id, said ->> '$.track_id'), said ->> '$.file_track_id' "
        "FROM labels "
        "WHERE frame_id IN (SELECT frames.id FROM frames JOIN recordings ON recordings.id = frames.recording_id "
        "WHERE rig_id = (SELECT rig_id FROM recordings WHERE id = ?)) AND coalesce(track_id, said) IS NOT NULL"
    )
    used, given = set[int](), dict[int, int]()
    with store.read() as connection:
        for track_id, name, said, file_track_id in driver_of(connection).execute(query, (recording_id,)):
            used |= {track_id, said}
            if name == source and said is not None:
                given[said if file_track_id is None else file_track_id] = said
    return used - {None}, given
