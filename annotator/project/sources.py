"""Proposals from other software, beside our own: each is a row; of those that see one object, the surest is shown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from annotator.geometry.iou import intersection_volume_pairs, iou_3d_matrix
from annotator.project.audit.making import said_row
from annotator.project.audit.writing import Write, WriteContext
from annotator.project.changes import NewLabel
from annotator.project.classes.attributes import fitting
from annotator.project.classes.values import Values, conflicts, lent, new_values, of_tracks, own_values
from annotator.project.database.store import Store, driver_of
from annotator.project.labels import certainty
from annotator.project.log import Writer
from annotator.project.records import OWN, BoxRecord, SaidRecord, storable
from annotator.project.rows import Row, Terms, said_in, said_with, values_json
from annotator.types import Label, OrientedBox, Proposal, ReviewState, Source
from annotator.types.label import AttributeValue

# Minimum exact 3D IoU at which two boxes count as the same object.
SAME_OBJECT_IOU = 0.5


class Staying(NamedTuple):
    """A label that an import does not replace; camera frame."""

    uid: str
    label: str
    box: OrientedBox


def covered_by(
    proposals: Sequence[Proposal | Label | NewLabel], reviewed: Iterable[Label | Staying]
) -> list[str | None]:
    """For each proposal, the uid of the reviewed label of its class with the greatest 3D IoU, if 0.5 or more."""
    covering: list[str | None] = [None] * len(proposals)
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
                covering[index] = candidates[best].uid
    return covering


def merged(said: Sequence[SaidRecord]) -> list[list[int]]:
    """Returns the places of the boxes of each object, that of the box to show first; two of a source stay apart.

    Boxes of two sources are one object if their exact 3D IoU is 0.5 or more, whatever their classes. The surest box is
    shown. A box without a score counts as sure. If two are equally sure, it is that of the other software, since
    somebody wants to see it; otherwise the earlier one.
    """
    if len({each.source for each in said}) <= 1:
        return [[place] for place in range(len(said))]
    order = sorted(range(len(said)), key=lambda place: certainty(said[place]))
    overlaps = _overlaps(said)
    groups: list[list[int]] = []
    for place in order:
        free = [group for group in groups if said[place].source not in {said[other].source for other in group}]
        best = max(free, key=lambda group: overlaps.get((group[0], place), 0.0), default=None)
        if best is not None and overlaps.get((best[0], place), 0.0) >= SAME_OBJECT_IOU:
            best.append(place)
        else:
            groups.append([place])
    return groups


def _overlaps(said: Sequence[SaidRecord]) -> dict[tuple[int, int], float]:
    """The IoU of the boxes of different sources that may touch, by the places of both, in either order."""
    centers, sizes = np.array([each.box.center_m for each in said]), np.array([each.box.size_m for each in said])
    rotations = np.array([each.box.rotation for each in said])
    reach = np.linalg.norm(sizes, axis=1) / 2
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    names = np.array([each.source for each in said])
    near = (apart < reach[:, None] + reach) & (names[:, None] != names)
    first, second = np.nonzero(np.triu(near))
    if len(first) == 0:
        return {}
    parts = (values[chosen] for chosen in (first, second) for values in (centers, rotations, sizes))
    shared, volumes = intersection_volume_pairs(*parts), sizes.prod(axis=1)
    iou = shared / (volumes[first] + volumes[second] - shared)
    pairs = dict(zip(zip(first.tolist(), second.tolist(), strict=True), iou.tolist(), strict=True))
    return pairs | {(b, a): value for (a, b), value in pairs.items()}


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


def bring(
    writer: Writer,
    source: str,
    frames_boxes: Mapping[int, Sequence[NewLabel]],
    author: str | None = None,
    action: str | None = None,
) -> dict[int, Brought]:
    """Makes boxes of one source the proposals of some frames; they replace what the same source has said there before.

    A box is not proposed if a label of its class covers it (exact 3D IoU 0.5 or more) that is reviewed, a proposal of
    which a person has set values, or one that another camera of the moment has. Of boxes of several sources, and of
    ours, that overlap as much, one is shown (`merged`).

    Args:
        frames_boxes: by frame id; the boxes' states are ignored. A track id of a reviewed label of the frame is not
            used again. All are stored in one transaction, so give a few frames at once.
        author: who brings them; None = the source itself.
        action: id of the action (`new_action`) that undoes them; None = they cannot be undone.

    Returns:
        The results by frame id; finalised frames are left out, and stay as they are.
    """
    author, done = author or source, dict[int, Brought]()
    with writer.store.write() as connection:
        terms = Terms(connection)
        places = ", ".join(map(str, map(int, frames_boxes)))
        query = f"SELECT id, moment_id, revision, finalised FROM frames WHERE id IN ({places}) ORDER BY id"
        newest = dict[int, int]()
        for frame_id, moment_id, revision, finalised in driver_of(connection).execute(query).fetchall():
            if not finalised:
                # another camera of the moment may have changed it in this transaction
                based_on = newest.get(moment_id, revision)
                context = WriteContext(based_on, author, Source.IMPORTED, effort_target=source)
                where = f"frame with id {frame_id}"
                write = Write(writer.store, connection, frame_id, where, context, action, terms)
                with storable(f"a box of {source}"):
                    done[frame_id] = _bring(write, source, frames_boxes[frame_id])
                newest[moment_id] = write.finish().revision
        return done


def _bring(write: Write, source: str, boxes: Sequence[NewLabel]) -> Brought:
    terms, waiting = write.terms, write.open_proposals()
    uids = {row["uid"] for row in waiting}
    staying = [
        Staying(row["uid"], terms.names[row["class_id"]], terms.box(row["box"], write.frame_id))
        for row in write.labels()
        if row["uid"] not in uids and row["behind"] is None
    ]
    for row in waiting:
        if row["of_source"] == source:
            write.put("labels", row["uid"], None)
    covering = covered_by(boxes, staying)
    new = [_said(source, box) for box, uid in zip(boxes, covering, strict=True) if uid is None]
    left = [row for row in waiting if row["of_source"] != source]
    groups = regroup(write, left, [(said_row(write, each), each) for each in new])
    write.event(KIND)
    together = sum(len(group) > 1 and any(each.source == source for each in group) for group in groups)
    differing = 0
    for group in groups if write.terms.attributes else ():
        its = [each.attributes for each in group if each.source == source]
        others = [each.attributes for each in group if each.source != source]
        differing += conflicts(write.terms.attributes_of(group[0].label), its, others)
    return Brought(tuple(uid is None for uid in covering), together, differing)


def regroup(write: Write, waiting: Sequence[Row], new: Iterable[tuple[Row, SaidRecord]] = ()) -> list[list[SaidRecord]]:
    """Shows, of the proposals of a frame that see one object, the surest; the others get behind it.

    Args:
        waiting: all open ones (`Write.open_proposals`).
        new: further rows, with what their sources say.

    Returns:
        The objects, each source in its own words.
    """
    found = [*((row, _words(write, row)) for row in waiting), *new]
    groups = [[found[place] for place in group] for group in merged([said for _, said in found])]
    uids = {row["uid"] for row, _ in found}
    stay = [row for row in write.labels() if row["uid"] not in uids and row["state"] != ReviewState.REJECTED.value]
    # a track has one box in a frame
    taken = {None, *write.hidden_tracks(), *(row["track_id"] for row in stay if row["behind"] is None)}
    taken |= {row["track_id"] for (row, said), *_ in groups if said.source == OWN}
    tracks = list[int | None]()
    for group in groups:
        row, said = group[0]
        free = (each.track_id for _, each in group if each.track_id not in taken)
        tracks.append(row["track_id"] if said.source == OWN else next(free, None))
        taken.add(tracks[-1])
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
                columns |= _values_columns(write, row, said, said.attributes)
            write.put("labels", row["uid"], row | columns)
    return [[said for _, said in group] for group in groups]


def _words(write: Write, row: Row) -> SaidRecord:
    """What the source of an open proposal says, in its own words."""
    said = said_in(row, write.terms.key, write.terms.place(write.frame_id))
    return said if row["said"] is None else said.model_copy(update={"attributes": own_values(row, write.terms)})


def _with_values(
    write: Write, row: Row, said: SaidRecord, lenders: Sequence[Values], of_track: Mapping[str, AttributeValue]
) -> Row:
    """The columns of a shown box with the values of its object: of its sources, else of its track, else the defaults.

    A proposal of ours has them already, unless other sources lend it some.
    """
    of_label = write.terms.attributes_of(said.label)
    borrowed = lent(of_label, said.attributes, lenders)
    if said.source == OWN and not borrowed and row["said"] is None:
        return {}
    values = new_values(of_label, of_track, fitting(of_label, said.attributes) | borrowed)
    return _values_columns(write, row, said, values, keep=bool(borrowed))


def _values_columns(write: Write, row: Row, said: SaidRecord, given: Values, *, keep: bool = False) -> Row:
    """The columns of a box with values that it is given; of ours, its own words are kept only if it borrows some."""
    text: str | None = row["said"]
    if said.source != OWN:
        assert text is not None  # as of all other software
        text = said_with(text, said.attributes, given)
    else:
        kept = said.model_copy(update={"given": given})
        text = write.terms.said_json(kept, write.frame_id) if keep else None
    return {"attributes": values_json(given), "said": text}


def source_tracks(store: Store, recording_id: int, source: str) -> tuple[set[int], dict[int, int]]:
    """All track ids of a recording's rig, also of hidden boxes; and those of `source`, by the ids in its files."""
    query = (
        "SELECT track_id, of_source, said ->> '$.track_id', said ->> '$.file_track_id' FROM labels "
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


def _said(source: str, box: NewLabel) -> SaidRecord:
    values = {name: value for name, value in vars(box).items() if name in SaidRecord.model_fields}
    return SaidRecord(source=source, **values | {"box": BoxRecord.of(box.box)})
