"""Proposals from other software, beside our own: one proposal for each object, which holds what every source says."""

from __future__ import annotations

import uuid
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from sqlalchemy import func, select, true

from annotator.geometry.iou import intersection_volume_pairs, iou_3d_matrix
from annotator.project.audit.making import new_label, said_json
from annotator.project.audit.writing import Write, WriteContext
from annotator.project.classes.values import (
    Values,
    borrowed,
    conflicts,
    given_back,
    is_kept,
    lend,
    lent_names,
    new_values,
    of_tracks,
    without,
)
from annotator.project.config import read_config
from annotator.project.database.schema import columns_of, frames, labels
from annotator.project.database.store import Store, driver_of
from annotator.project.labels import NewLabel
from annotator.project.log import Writer
from annotator.project.records import OWN, BoxRecord, OwnColumns, SaidRecord, storable, track_of
from annotator.project.rows import Row, Terms, values_json, values_of
from annotator.types import BoxKind, OrientedBox, ReviewState, Source

# Minimum exact 3D IoU at which two boxes count as the same object.
SAME_OBJECT_IOU = 0.5


@runtime_checkable
class Boxed(Protocol):
    """A class name with a 3D box, such as a `Proposal` or a `Label`."""

    @property
    def label(self) -> str:
        """Class name."""

    @property
    def box(self) -> OrientedBox:
        """Camera frame."""


class Known(Boxed, Protocol):
    """A box with a uid, such as a `Label`."""

    @property
    def uid(self) -> str:
        """Of the label."""


def covered_by(proposals: Sequence[Boxed], reviewed: Iterable[Known]) -> list[str | None]:
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


Group = tuple[SaidRecord, ...]
"""What the sources say of one object; the first box is the one to show."""


def merged(said: Sequence[SaidRecord]) -> list[Group]:
    """Returns one group for each object, with at most one box of each source; two boxes of a source stay apart.

    Boxes of two sources are one object if their exact 3D IoU is 0.5 or more, whatever their classes. The surest box is
    shown. A box without a score counts as sure. If two are equally sure, it is that of the other software, since
    somebody wants to see it; otherwise the earlier one.
    """
    if len({each.source for each in said}) <= 1:
        return [(each,) for each in said]
    ranked = sorted(said, key=lambda each: (-1.0 if each.score is None else -each.score, each.source == OWN))
    overlaps = _overlaps(ranked)
    groups: list[list[int]] = []
    for index, each in enumerate(ranked):
        free = [group for group in groups if each.source not in {ranked[other].source for other in group}]
        best = max(free, key=lambda group: overlaps.get((group[0], index), 0.0), default=None)
        if best is not None and overlaps.get((best[0], index), 0.0) >= SAME_OBJECT_IOU:
            best.append(index)
        else:
            groups.append([index])
    return [tuple(ranked[index] for index in group) for group in groups]


def _overlaps(said: Sequence[SaidRecord]) -> dict[tuple[int, int], float]:
    """The IoU of the boxes of different sources that may touch, by the indices of both, the smaller one first."""
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
    return dict(zip(zip(first.tolist(), second.tolist(), strict=True), iou.tolist(), strict=True))


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

    A box is not proposed if a reviewed label of its class, or a proposal of which a person has set values, covers it
    (exact 3D IoU 0.5 or more). Boxes of several sources that overlap as much become one proposal, together with our own
    (`merged`).

    Args:
        frames_boxes: by frame id; the boxes' states are ignored. A track id of a reviewed label of the frame is not
            used again. All are stored in one transaction, so give a few frames at once.
        author: who brings them; None = the source itself.
        action: id of the action (`new_action`) that undoes them; None = they cannot be undone.

    Returns:
        The results by frame id; finalised frames are left out, and stay as they are.
    """
    columns, author = columns_of("labels"), author or source
    with writer.store.write() as connection:
        config, terms, places = (
            read_config(writer.folder),
            Terms(connection),
            ", ".join(map(str, map(int, frames_boxes))),
        )
        driver, present = driver_of(connection), defaultdict[int, list[Row]](list)
        for values in driver.execute(
            f"SELECT {', '.join(columns)} FROM labels WHERE frame_id IN ({places}) ORDER BY id"
        ):
            row = dict(zip(columns, values, strict=True))
            present[row["frame_id"]].append(row)
        found = driver.execute(
            f"SELECT id, revision, finalised FROM frames WHERE id IN ({places}) ORDER BY id"
        ).fetchall()
        done = dict[int, Brought]()
        for frame_id, revision, finalised in found:
            if not finalised:
                context = WriteContext(revision, author, Source.IMPORTED, effort_target=source)
                where = f"frame with id {frame_id}"
                write = Write(writer.store, writer.folder, connection, frame_id, where, context, action, config, terms)
                write.know_all(present[frame_id])
                with storable(f"a box of {source}"):
                    done[frame_id] = _bring(write, source, frames_boxes[frame_id])
        return done


class _Staying(NamedTuple):
    uid: str
    label: str
    box: OrientedBox


def _bring(write: Write, source: str, boxes: Sequence[NewLabel]) -> Brought:
    proposed, terms = OpenProposals.of(write), write.terms
    staying = [
        _Staying(row["uid"], terms.names[row["class_id"]], terms.box(row["box"], write.frame_id))
        for row in write.labels()
        if not _is_open(row, proposed.kept)
    ]
    new, covering = [_said(source, box) for box in boxes], covered_by(boxes, staying)
    free = [each for each, uid in zip(new, covering, strict=True) if uid is None]
    groups = replace_open(write, proposed, [*(each for each in proposed.others if each.source != source), *free])
    write.event(KIND)
    attributes = write.config.attributes
    together = sum(len(group) > 1 and any(each.source == source for each in group) for group in groups)
    differing = sum(conflicts([a for a in attributes if a.is_of(group[0].label)], group, source) for group in groups)
    write.finish()
    return Brought(tuple(uid is None for uid in covering), together, differing)


def show_others(write: Write, removed: Collection[str], uids: Collection[str]) -> None:
    """Shows other sources' boxes in the place of the proposals `uids`, whose classes are about to be removed."""
    proposed = OpenProposals.of(write, uids)
    gone = {each.uid for each in proposed.ours if each.label in removed}
    others = [each for each in proposed.others if each.label not in removed]
    replace_open(write, proposed, others, leaving_out=gone)
    write.event(KIND)


def _is_open(row: Row, kept: Collection[str]) -> bool:
    """Whether an import may replace a label: an open proposal that is not `kept`."""
    return row["state"] == ReviewState.PROPOSED.value and row["uid"] not in kept


def source_tracks(store: Store, recording_id: int, source: str) -> tuple[set[int], dict[int, int]]:
    """All track ids of a recording, also of hidden boxes; and those of `source`, by the ids in its files."""
    said = func.json_each(labels.c.said).table_valued("value")
    values = [func.json_extract(said.c.value, f"$.{name}") for name in ("track_id", "source", "file_track_id")]
    of_recording = labels.join(frames, frames.c.id == labels.c.frame_id)
    here = frames.c.recording_id == recording_id
    of_labels = select(labels.c.track_id).select_from(of_recording).where(here, labels.c.track_id.is_not(None))
    is_known = values[0].is_not(None)
    of_sources = select(*values).select_from(of_recording.join(said, true())).where(here, is_known).distinct()
    with store.read() as connection:
        used, given = set(connection.execute(of_labels.distinct()).scalars()), dict[int, int]()
        for track_id, name, file_track_id in connection.execute(of_sources):
            used.add(track_id)
            if name == source:
                given[track_id if file_track_id is None else file_track_id] = track_id
    return used, given


def _said(source: str, box: NewLabel) -> SaidRecord:
    values = {name: value for name, value in vars(box).items() if name in SaidRecord.model_fields}
    return SaidRecord(uid=uuid.uuid4().hex, source=source, **values | {"box": BoxRecord.of(box.box)})


def _with_free_tracks(groups: Sequence[Group], taken: Collection[int | None]) -> tuple[Group, ...]:
    """The groups without track ids that other labels of the frame have: a track has one box in a frame."""
    taken, free, none = set(taken) - {None}, list[Group](), {"track_id": None, "file_track_id": None}
    for group in groups:
        group = tuple(each.model_copy(update=none) if each.track_id in taken else each for each in group)
        taken.add(track_of(group))
        taken.discard(None)
        free.append(group)
    return tuple(free)


@dataclass(frozen=True)
class OpenProposals:
    """What the open proposals of a frame say.

    Attributes:
        others: boxes of other software, in their own words; boxes of ours that one of them hides, as well.
        kept: uids of proposals that stay as they are; neither list has them.
        taken: track ids of the labels that stay, except rejected ones.
        borrows: uids of the proposals to which hidden boxes have lent values.
    """

    others: list[SaidRecord]
    ours: list[SaidRecord]
    kept: frozenset[str]
    taken: frozenset[int]
    borrows: frozenset[str] = frozenset()

    @classmethod
    def of(cls, write: Write, never_kept: Collection[str] = ()) -> OpenProposals:
        """Reads them from a frame's rows, without boxes of classes that the project no longer has.

        Proposals of `never_kept` may be replaced, though a person has set values.
        """
        others, ours, borrows, taken, kept = list[SaidRecord](), list[SaidRecord](), set[str](), set[int](), set[str]()
        for row in write.labels():
            uid, label = row["uid"], write.terms.names[row["class_id"]]
            said = write.terms.said(row["said"], write.frame_id)
            if row["values_set"] and uid not in never_kept and is_kept(row, label, said, write.config.attributes):
                kept.add(uid)
            if not _is_open(row, kept):
                if row["state"] != ReviewState.REJECTED.value and row["track_id"] is not None:
                    taken.add(row["track_id"])
                continue
            present = values_of(row["attributes"])
            values = without(present, borrowed(present, said))
            others += [
                each.model_copy(update={"attributes": values}) if each.uid == uid else each
                for each in given_back(uid, said)
            ]
            borrows |= {uid} if lent_names(said) else set()
            if row["source"] != Source.IMPORTED.value:
                ours.append(
                    SaidRecord(
                        uid=uid,
                        source=OWN,
                        label=label,
                        score=row["score"],
                        box=write.terms.record(row["box"], write.frame_id),
                        track_id=row["track_id"],
                        box_kind=BoxKind(row["box_kind"]),
                        attributes=values,
                    )
                )
        shown = [each for each in others if each.label in write.config.classes]
        return cls(shown, ours, frozenset(kept), frozenset(taken), frozenset(borrows))


def replace_open(
    write: Write, proposed: OpenProposals, others: Sequence[SaidRecord], *, leaving_out: Collection[str] = ()
) -> list[Group]:
    """Replaces the open proposals of a frame by one for each object that our own proposals and the others see.

    A proposal that stays the same keeps its row.

    Args:
        proposed: the present ones.
        leaving_out: uids of our own proposals that are removed.

    Returns:
        The objects, each source in its own words.
    """
    rows = {row["uid"]: row for row in write.labels() if _is_open(row, proposed.kept)}
    ours = [each for each in proposed.ours if each.uid not in leaving_out]
    uids = {each.uid for each in ours}
    groups = merged([*others, *ours])
    of_ours = [group for group in groups if group[0].uid in uids]
    of_others = [group for group in groups if group[0].uid not in uids]
    of_others = list(
        _with_free_tracks(of_others, proposed.taken.union(rows[group[0].uid]["track_id"] for group in of_ours))
    )
    attributes = write.config.attributes
    known = [*(track_of(group) for group in of_others), *(rows[group[0].uid]["track_id"] for group in of_ours)]
    tracks: Mapping[int | None, Values] = {}
    if attributes:
        tracks = of_tracks(write.connection, write.terms, attributes, write.frame_id, known)

    def with_values(group: Group, track_id: int | None) -> Group:
        """The group with the values of its object: of its sources, else of its track, else the defaults."""
        if not attributes:
            return group
        of_label = [each for each in attributes if each.is_of(group[0].label)]
        lent, others = lend(of_label, group[0].attributes, group[1:])
        values = new_values(of_label, tracks.get(track_id, {}), lent)
        return group[0].model_copy(update={"attributes": values, "lent": ()}), *others

    after = dict[str, Row]()
    for group in of_ours:
        row = rows[group[0].uid]
        if group[0].uid in proposed.borrows or any(each.attributes for each in group[1:]):
            group = with_values(group, row["track_id"])
            row = row | {"attributes": values_json(group[0].attributes)}
        after[row["uid"]] = row | {"said": said_json(write, group[1:])}
    for group in of_others:
        whole = with_values(tuple(_with_columns(each, rows.get(each.uid)) for each in group), track_of(group))
        after[group[0].uid] = _row(write, whole, rows.get(group[0].uid))
    for uid in rows:
        if uid not in after:
            write.put("labels", uid, None)
    for uid, row in after.items():
        write.put("labels", uid, row)
    return groups


def _with_columns(said: SaidRecord, row: Row | None) -> SaidRecord:
    """What we say, with what only the row of our proposal knows, for when it is shown again."""
    if said.source != OWN or row is None or said.own is not None:
        return said
    return said.model_copy(update={"own": OwnColumns(**{name: row[name] for name in OwnColumns.model_fields})})


def _row(write: Write, group: Group, present: Row | None) -> Row:
    """The row of an object whose shown box is none of our open proposals."""
    shown = group[0]
    is_ours = shown.source == OWN
    own = shown.own or OwnColumns(author=shown.source)
    columns = own.model_dump() | {
        "class_id": write.class_id(shown.label),
        "box": write.terms.box_json(shown.box, write.frame_id),
        "score": shown.score,
        "state": ReviewState.PROPOSED.value,
        "track_id": track_of(group),
        "box_kind": shown.box_kind.value,
        "said": said_json(write, group[1:] if is_ours else group),
        "attributes": values_json(shown.attributes),
        "source": (Source.AUTO if is_ours else Source.IMPORTED).value,
    }
    if present is None:
        return new_label(write, shown.uid, shown.label, **columns)
    return present | columns
