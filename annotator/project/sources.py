"""Proposals from other software, beside our own: one proposal for each object, which holds what every source says."""

from __future__ import annotations

import uuid
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from sqlalchemy import Connection, bindparam, func, select, true

from annotator.geometry.iou import intersection_volume_pairs, iou_3d_matrix
from annotator.project.classes.applying import values_of
from annotator.project.classes.completing import borrowed, conflicts, given_back, kept_proposals, lent_names, without
from annotator.project.config import ProjectConfig, read_config
from annotator.project.database.schema import LABELS_OF_FRAME, AnyRow, frames, labels
from annotator.project.labels import NewLabel, stored_label
from annotator.project.log.event_types import CoveredBox, OwnProposal, ProposalsImported
from annotator.project.log.records import OWN, BoxRecord, SaidRecord, parsed, said_of, storable, track_of
from annotator.project.log.writing import Receipt, WriteContext, Writer
from annotator.types import BoxKind, Label, OrientedBox, ReviewState, Source

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


def covered_by(proposals: Sequence[Boxed], reviewed: Iterable[Label]) -> list[str | None]:
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
    ranked = sorted(said, key=lambda each: (-_certainty(each), each.source == OWN))
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


def _certainty(said: SaidRecord) -> float:
    return 1.0 if said.score is None else said.score


# --- storing what a source says ---------------------------------------------------------------------------------------

# Built once, since building a statement takes longer than running it.
_OF_FRAMES = select(labels).where(labels.c.frame_id.in_(bindparam("frames", expanding=True))).order_by(labels.c.id)


@dataclass(frozen=True)
class Brought:
    """Result of storing one source's boxes of a frame.

    Attributes:
        is_open: for each of them, False if a reviewed label covers it, so that it is not proposed.
        merged: number of the others that other sources see as well, or our own proposals.
        conflicts: number of their values that another source says otherwise; the surest box's are shown.
        receipt: of the write.
    """

    is_open: tuple[bool, ...]
    merged: int
    conflicts: int
    receipt: Receipt


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
        source: name of the detector, person or file that the boxes come from.
        frames_boxes: by frame id; the boxes' states are ignored. A track id of a reviewed label of the frame is not
            used again. All are stored in one transaction, so give a few frames at once.
        author: who brings them; None = the source itself.
        action: id of the action (`new_action`) that undoes them; None = they cannot be undone.

    Returns:
        The results by frame id; finalised frames are left out, and stay as they are.
    """
    with writer.store.write() as connection:
        config = read_config(writer.folder)
        columns = select(frames.c.id, frames.c.revision, frames.c.finalised)
        rows = connection.execute(columns.where(frames.c.id.in_(frames_boxes))).all()
        present = defaultdict[int, list[AnyRow]](list)
        for row in connection.execute(_OF_FRAMES, {"frames": [*frames_boxes]}):
            present[row.frame_id].append(row)
        return {
            row.id: _bring(
                connection,
                writer,
                source,
                frames_boxes[row.id],
                _Place(row.id, row.revision, present[row.id], config),
                author or source,
                action,
            )
            for row in rows
            if not row.finalised
        }


@dataclass(frozen=True)
class _Place:
    frame_id: int
    revision: int
    rows: Sequence[AnyRow]
    config: ProjectConfig


def _bring(
    connection: Connection,
    writer: Writer,
    source: str,
    boxes: Sequence[NewLabel],
    place: _Place,
    author: str,
    action: str | None,
) -> Brought:
    rows, attributes = place.rows, place.config.attributes
    kept = kept_proposals(connection, attributes, place.frame_id) if rows else frozenset[str]()
    staying = [stored_label(row).label for row in rows if not _is_open(row, kept)]
    with storable(f"a box of {source}"):
        new = [_said(source, box) for box in boxes]
        covering = covered_by(boxes, staying)
        free = [each for each, uid in zip(new, covering, strict=True) if uid is None]
        covered = [CoveredBox(said=each, by=uid) for each, uid in zip(new, covering, strict=True) if uid]
        proposed = _Open.of(rows, place.config.classes, kept)
        payload = proposed.after(source, free, covered)
    context = WriteContext(place.revision, author, Source.IMPORTED)
    receipt = writer.to_frame_in(connection, place.frame_id, (payload,), context, action, place.config)
    together = sum(len(group) > 1 and any(each.source == source for each in group) for group in payload.objects)
    together += sum(any(each.source == source for each in own.said) for own in payload.ours)
    groups = [*payload.objects]
    groups += [(each, *own.said) for own in payload.ours for each in proposed.ours if each.uid == own.uid]
    differing = sum(conflicts([a for a in attributes if a.is_of(group[0].label)], group, source) for group in groups)
    return Brought(tuple(uid is None for uid in covering), together, differing, receipt)


def said_again(
    connection: Connection, frame_id: int, source: str, said: Sequence[SaidRecord], config: ProjectConfig
) -> ProposalsImported:
    """Returns the event after which `source` says this of a frame, as it did at another time.

    Args:
        config: of the project.
    """
    kept = kept_proposals(connection, config.attributes, frame_id)
    staying = connection.execute(select(labels.c.said).where(labels.c.uid.in_(kept))).scalars()
    present = {each.uid for content in staying for each in said_of(content)}
    known = [each for each in said if each.label in config.classes and each.uid not in present]
    return _Open.of(_labels(connection, frame_id), config.classes, kept).after(source, known, [])


def without_classes(
    connection: Connection, removed: Collection[str], config: ProjectConfig
) -> Iterator[tuple[int, ProposalsImported]]:
    """Yields the event that shows other sources' boxes where one of a class that is about to be removed is shown.

    Args:
        config: of the project, before the change.

    Yields:
        Frame id and event.
    """
    staying = [name for name in config.classes if name not in removed]
    gone = (labels.c.state == ReviewState.PROPOSED.value) & labels.c.label.in_(removed)
    query = select(labels.c.frame_id, labels.c.uid, labels.c.said).where(gone, labels.c.said.is_not(None))
    shown: dict[int, set[str]] = defaultdict(set)
    for frame_id, uid, content in connection.execute(query.order_by(labels.c.frame_id)):
        if any(each.label in staying for each in said_of(content)):
            shown[frame_id].add(uid)
    for frame_id, uids in shown.items():
        kept = kept_proposals(connection, config.attributes, frame_id) - uids
        proposed = _Open.of(_labels(connection, frame_id), staying, kept)
        ours = [each for each in proposed.ours if each.label not in removed]
        hidden = [each for each in proposed.others if each.source == OWN]
        yield frame_id, _Open(proposed.others, ours, kept, proposed.taken, proposed.borrows).after(OWN, hidden, [])


def _labels(connection: Connection, frame_id: int) -> Sequence[AnyRow]:
    """The rows of a frame's labels, in order."""
    return connection.execute(LABELS_OF_FRAME, {"frame": frame_id}).all()


def _is_open(row: AnyRow, kept: Collection[str]) -> bool:
    """Whether an import may replace a label: an open proposal that is not `kept`."""
    return row.state == ReviewState.PROPOSED.value and row.uid not in kept


def beside_new_pass(
    connection: Connection,
    frame_id: int,
    new: Sequence[SaidRecord],
    classes: Collection[str],
    kept: frozenset[str] = frozenset(),
) -> ProposalsImported | None:
    """Returns the event that follows an automatic pass, so that one object stays one proposal.

    Args:
        new: the pass's proposals.
        classes: of the project.
        kept: uids of proposals that the pass does not replace.

    Returns:
        The event; None if the frame has no boxes of other software.
    """
    proposed = _Open.of(_labels(connection, frame_id), classes, kept)
    if not proposed.others:
        return None
    return _Open(proposed.others, list(new), kept, proposed.taken).after(OWN, [], [])


@dataclass(frozen=True)
class SourceTracks:
    """Track ids of a recording.

    Attributes:
        used: of all labels, also what hidden boxes of sources say.
        given: id in the files of one source -> its track id.
    """

    used: frozenset[int]
    given: Mapping[int, int]


def source_tracks(writer: Writer, recording_id: int, source: str) -> SourceTracks:
    """Returns the track ids of a recording, and those of `source` among them."""
    said = func.json_each(labels.c.said).table_valued("value")
    values = [func.json_extract(said.c.value, f"$.{name}") for name in ("track_id", "source", "file_track_id")]
    of_recording = labels.join(frames, frames.c.id == labels.c.frame_id)
    here = frames.c.recording_id == recording_id
    of_labels = select(labels.c.track_id).select_from(of_recording).where(here, labels.c.track_id.is_not(None))
    is_known = values[0].is_not(None)
    of_sources = select(*values).select_from(of_recording.join(said, true())).where(here, is_known).distinct()
    with writer.store.read() as connection:
        used, given = set(connection.execute(of_labels.distinct()).scalars()), dict[int, int]()
        for track_id, name, file_track_id in connection.execute(of_sources):
            used.add(track_id)
            if name == source:
                given[track_id if file_track_id is None else file_track_id] = track_id
    return SourceTracks(frozenset(used), given)


def _said(source: str, box: NewLabel) -> SaidRecord:
    return SaidRecord(
        uid=uuid.uuid4().hex,
        source=source,
        label=box.label,
        score=box.score,
        box=BoxRecord.of(box.box),
        track_id=box.track_id,
        file_track_id=box.file_track_id,
        box_kind=box.box_kind,
        attributes=dict(box.attributes),
    )


def _with_free_tracks(groups: Sequence[Group], taken: Collection[int | None]) -> tuple[Group, ...]:
    """The groups without track ids that other labels of the frame have: a track has one box in a frame."""
    taken, free = set(taken), list[Group]()
    for group in groups:
        group = tuple(_without_track(each) if each.track_id in taken else each for each in group)
        taken.add(track_of(group))
        taken.discard(None)
        free.append(group)
    return tuple(free)


def _without_track(said: SaidRecord) -> SaidRecord:
    return said if said.track_id is None else said.model_copy(update={"track_id": None, "file_track_id": None})


@dataclass(frozen=True)
class _Open:
    """What the open proposals of a frame say.

    Attributes:
        others: boxes of other software; boxes of ours that one of them hides, as well.
        ours: our own open proposals.
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
    def of(cls, rows: Iterable[AnyRow], classes: Collection[str], kept: frozenset[str]) -> _Open:
        """Reads them from the rows of a frame's labels, without boxes of classes that the project no longer has."""
        others, ours, borrows, taken = list[SaidRecord](), list[SaidRecord](), set[str](), set[int]()
        for row in rows:
            if not _is_open(row, kept):
                if row.state != ReviewState.REJECTED.value and row.track_id is not None:
                    taken.add(row.track_id)
                continue
            said = said_of(row.said)
            present = values_of(row.attributes)
            values = without(present, borrowed(present, said))
            others += [
                each.model_copy(update={"attributes": values}) if each.uid == row.uid else each
                for each in given_back(row.uid, said)
            ]
            borrows |= {row.uid} if lent_names(said) else set()
            if row.source != Source.IMPORTED.value:
                box = parsed(BoxRecord.model_validate_json, row.box)
                score, track_id, kind = row.score, row.track_id, BoxKind(row.box_kind)
                ours.append(
                    SaidRecord(
                        uid=row.uid,
                        source=OWN,
                        label=row.label,
                        score=score,
                        box=box,
                        track_id=track_id,
                        box_kind=kind,
                        attributes=values,
                    )
                )
        shown = [each for each in others if each.label in classes]
        return cls(shown, ours, kept, frozenset(taken), frozenset(borrows))

    def after(self, source: str, new: Sequence[SaidRecord], covered: Sequence[CoveredBox]) -> ProposalsImported:
        """Returns the event that replaces what `source` says by `new`."""
        uids = {each.uid for each in self.ours}
        groups = merged([*(each for each in self.others if each.source != source), *new, *self.ours])
        taken = self.taken.union(group[0].track_id for group in groups if group[0].uid in uids)
        return ProposalsImported(
            source=source,
            objects=_with_free_tracks([group for group in groups if group[0].uid not in uids], taken),
            ours=tuple(self._own(*group) for group in groups if group[0].uid in uids),
            hidden=tuple(each.uid for group in groups for each in group[1:] if each.uid in uids),
            covered=tuple(covered),
            kept=tuple(sorted(self.kept)),
        )

    def _own(self, shown: SaidRecord, *others: SaidRecord) -> OwnProposal:
        """Our proposal of an object; its values change only where other sources lend some, or did so before."""
        changes = shown.uid in self.borrows or any(each.attributes for each in others)
        return OwnProposal(uid=shown.uid, said=others, attributes=shown.attributes if changes else None)
