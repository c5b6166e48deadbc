"""What an import of boxes tells: what it stored, left out and doubts, in sentences for the command and the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from itertools import islice, permutations
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.formats.reading import Lengths
from annotator.formats.table import BoxFormat, FlatFormat
from annotator.project import Project
from annotator.rcv.config import TypicalSize, typical_size
from annotator.types import Source
from annotator.types.messages import amount, nearest
from annotator.workflows.importing.label_set import ScoreRange
from annotator.workflows.importing.pictures import placed_pictures, read_pictures
from annotator.workflows.importing.placing import Matched
from annotator.workflows.importing.readers import read_labels


class Become(StrEnum):
    """What 3D boxes become."""

    LABELS = "labels"
    PROPOSALS = "proposals"
    FLAT = "2d"


class Note(Enum):
    """What an import tells beside the boxes that it stored: the noun of what is counted, and the sentence.

    In a sentence, {n} is the number with the noun, {by} the number of each detail, {names} the first details. One with
    {of} is one for each detail. Details are texts for DOUBT, UNREADABLE (`key: reason`), RENAMED and SCALED; the class
    for OTHER_CLASS, WITHOUT_VIEWS, OUTSIDE and HIDDEN; the attribute, with the reason, for VALUE; the name for the
    unmatched ones.
    """

    MERGED = ("box", "merged: {n} with proposals of other sources")
    AROUND = ("box", "turned or polygons: {n}; the rectangles around them were imported")
    REPLACED = ("camera image", "replaced: the boxes on {n}")
    WITHOUT_VIEWS = ("box", "on the image only, too few points for pseudo-views: {by}")
    OUTSIDE = ("box", "outside the image: {by}")
    HIDDEN = ("box", "hidden, without points of their own: {by}")
    ALREADY = (
        "frame",
        "unchanged: {n} with labels or proposals already, or finalised; boxes imported as proposals come beside labels",
    )
    FINALISED = ("finalised frame", "unchanged: {n}")
    DRAWN = ("frame", "unchanged: {n} with drawn boxes, or finalised")
    OTHERS_VIEWS = ("pseudo-view", "unchanged: {n} with boxes from elsewhere")
    FILLED = ("value", "attributes: {n} for labels and frames that had none")
    SHOWN = ("value", "attributes: {n} for the 3D labels and frames that these images show")
    CONTRADICTED = ("value", "unchanged: {n} of labels and frames in conflict with the file")
    COVERED = ("box", "skipped: {n} of objects with a label")
    UNSURE = ("box", "skipped: {n} with a lower score")
    REJECTED = ("box", "skipped: {n} rejected before")
    NOT_REVIEWED = ("box", "skipped: {n} not accepted")
    UNSEEN = ("box", "skipped: {n} outside the images of these frames")
    OTHER_CAMERA = ("box", "skipped: {n} that other cameras of the moment have")
    PARTIAL = ("box", "no labels imported: those of the recording are only of what its own camera sees")
    FLAT = ("row", "skipped: {n} with a 2D box and no 3D box (its height, width and length are -1)")
    DOUBT = ("box", "doubtful: {of}")
    CONFLICT = ("value", "in conflict with other sources: {n}; those of the surer boxes are shown")
    UNSCORED = ("box", "the boxes have no scores, so --min-score has no effect")
    SCALED = ("score", "scaled: scores from {of} are now 0 to 1")
    SCORE = ("score", "dropped: {n} outside 0..1")
    TRACK = ("track id", "dropped: {n} that an earlier box of the same frame has")
    UNREADABLE = ("frame", "unreadable: {of}")
    RENAMED = ("recording", "recording {of}")
    VALUE = ("value", "skipped: {n} of attribute {of}")
    OTHER_CLASS = ("box", "skipped: {n} of class {of}, which is not in the project")
    UNMATCHED = ("frame", "skipped: {n} without a match in the project: {names}")
    UNMATCHED_IMAGE = ("image", "skipped: {n} without a match in the project: {names}")


# Names that a sentence shows.
MOST_NAMES = 5


@dataclass
class ImportReport:
    """The report of one import.

    Attributes:
        become: what the boxes became.
        classes: of the project, for "did you mean".
        source: of proposals: the name under which the boxes are known.
        frames: number of frames that got boxes, or are empty in the dataset; for 2D boxes, of camera images.
        views: number of pseudo-views, likewise.
        boxes: number of boxes stored, by class.
        notes: numbers by detail, "" without one.
    """

    become: Become
    classes: tuple[str, ...] = ()
    source: str = ""
    frames: int = 0
    views: int = 0
    boxes: Counter[str] = field(default_factory=Counter)
    notes: dict[Note, Counter[str]] = field(default_factory=dict)

    def add(self, note: Note, number: int = 1, of: str = "") -> None:
        """Counts something."""
        if number:
            self.notes.setdefault(note, Counter())[of] += number

    def add_all(self, note: Note, of: Iterable[str]) -> None:
        """Counts each of some details once."""
        for each in of:
            self.add(note, of=each)

    def __getitem__(self, note: Note) -> int:
        return self.of(note).total()

    def of(self, note: Note) -> Counter[str]:
        """The numbers by detail."""
        return self.notes.get(note, Counter())

    def include(self, other: ImportReport) -> None:
        """Adds the numbers of another import."""
        self.frames, self.views = self.frames + other.frames, self.views + other.views
        self.boxes.update(other.boxes)
        for note, numbers in other.notes.items():
            self.notes.setdefault(note, Counter()).update(numbers)

    def headline(self) -> str:
        """What was stored."""
        if self.become is Become.LABELS:
            return f"imported as labels: {by_class(self.boxes)} in {amount(self.frames, 'frame')}"
        if self.become is Become.PROPOSALS:
            return f"proposed by {self.source}: {by_class(self.boxes)} in {amount(self.frames, 'frame')}"
        counts = {"camera image": self.frames, "pseudo-view": self.views}
        where = " and ".join(amount(number, what) for what, number in counts.items() if number) or "no image"
        return f"imported as 2D boxes: {by_class(self.boxes)} on {where}"

    def sentences(self, most: int | None = None) -> list[str]:
        """All other sentences, in the order of `Note`.

        Args:
            most: number of details with a sentence of their own; None = all.
        """
        return [line for note in Note if self.notes.get(note) for line in self._lines(note, most)]

    def text(self, most: int = MOST_NAMES) -> str:
        """The report in one line; `most` as for `sentences`."""
        return "; ".join([self.headline(), *self.sentences(most)])

    def _lines(self, note: Note, most: int | None) -> Iterable[str]:
        noun, words = note.value
        numbers = self.of(note)
        if "{of}" not in words:
            more = " ..." if len(numbers) > MOST_NAMES else ""
            names = ", ".join(islice(numbers, MOST_NAMES)) + more
            yield words.format(n=amount(numbers.total(), noun), by=by_class(numbers), names=names)
            return
        details = sorted(numbers.items()) if note in (Note.VALUE, Note.OTHER_CLASS) else list(numbers.items())
        for of, number in details[:most]:
            near = nearest(of, self.classes) if note is Note.OTHER_CLASS else None
            meant = "" if near is None else f"; did you mean {near!r}?"
            yield words.format(n=amount(number, noun), of=of) + meant
        if most is not None and len(details) > most:
            yield f"and {len(details) - most} more like this"


def by_class(counts: Mapping[str, int]) -> str:
    """Numbers with their classes, such as "2 car, 3 person"."""
    return ", ".join(f"{number} {name}" for name, number in sorted(counts.items())) or "no box"


# Factor by which a side may differ from the usual one, and standard deviations of its class if these are larger.
SIZE_FACTOR, SIZE_DEVIATIONS = 1.6, 3.0
# A class with a side this much longer than another one shows the order of sizes by itself; others need several boxes.
CLEAR_FACTOR, LEAST_UNCLEAR = 2.0, 3
SIDES = ("length", "width", "height")
# Classes whose length is along their heading; others, such as nuScenes' barriers and furniture, may be wider than long.
LONG = frozenset(
    {"car", "van", "truck", "bus", "trailer", "construction_vehicle", "tram"}
    | {"cyclist", "bicyclist", "motorcyclist", "bicycle", "motorcycle"}
)
# Classes that have no upright position.
FREE = frozenset({"hand"})


class SizeDoubts:
    """What the sizes of the boxes of a dataset show: another unit than metres, or another order.

    Attributes:
        lengths: of all boxes.
        orders: of boxes of well-known classes.
    """

    def __init__(self) -> None:
        self.lengths, self.orders = Lengths(), SizeOrders()

    def add(self, label: str, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds a box."""
        self.lengths.add(size_m)
        self.orders.add(label, size_m)

    def problem(self) -> str | None:
        """Returns what the sizes show; None if they seem right."""
        return self.lengths.problem() or self.orders.problem()


class SizeOrders:
    """Whether the sizes of boxes of well-known classes are in the order length, width, height."""

    def __init__(self) -> None:
        self._known = self._clear = 0
        self._orders: Counter[tuple[int, ...]] = Counter()
        self._example: dict[tuple[int, ...], str] = {}

    def add(self, label: str, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds the size of a box; one of another class shows nothing."""
        # nuScenes' classes are such as vehicle.car
        usual = next((size for name in (label, *label.split(".")) if (size := typical_size(name)) is not None), None)
        if usual is None or usual.label in FREE:
            return
        self._known += 1
        order = _order(usual, size_m)
        if order is not None:
            sides = " x ".join(f"{side:.2f}" for side in size_m)
            self._orders[order] += 1
            self._clear += max(usual.size_m) > CLEAR_FACTOR * min(usual.size_m)
            self._example.setdefault(order, f"{label} of {sides} m (length, width, height)")

    def problem(self) -> str | None:
        """Returns which order most boxes show; None if it is the right one."""
        odd = self._orders.total()
        if odd * 2 <= self._known or (self._clear == 0 and odd < LEAST_UNCLEAR):
            return None
        order, number = self._orders.most_common(1)[0]
        moved = [name for place, name in enumerate(SIDES) if order[place] != place]
        return (
            f"{number} of {amount(self._known, 'box')} of well-known classes {'has' if number == 1 else 'have'} the "
            f"usual size of the class only if {', '.join(moved[:-1])} and {moved[-1]} are exchanged, such as "
            f"{self._example[order]}; check the order in which the sizes are written"
        )


def _order(usual: TypicalSize, size_m: Float64[np.ndarray, "3"]) -> tuple[int, ...] | None:
    """Returns the order of the sides that is usual for the class; None if the present one is, or none is."""
    within = np.log(np.maximum(SIZE_FACTOR, np.exp(SIZE_DEVIATIONS * np.array(usual.spread))))
    fitting = {
        order: float(off.max())
        for order in permutations(range(3))
        if (off := np.abs(np.log(size_m[list(order)] / np.array(usual.size_m))) / within).max() <= 1
    }
    if not fitting or (0, 1, 2) in fitting or (usual.label not in LONG and (1, 0, 2) in fitting):
        return None
    return min(fitting, key=lambda order: fitting[order])


@dataclass(frozen=True)
class Preview:
    """What a dataset of boxes has.

    Attributes:
        is_3d: False for 2D boxes.
        frames: number of its frames or images with a frame in the project.
        ambiguous: number of those that fit frames of several recordings: one of these must be chosen.
        boxes: number of boxes on `frames`, by class.
        scores: the lowest and the highest score of 3D boxes, if there are any.
        notes: sentences about what an import would leave out, replace or not change.
    """

    is_3d: bool
    frames: int
    ambiguous: int
    boxes: dict[str, int]
    scores: ScoreRange | None
    notes: tuple[str, ...]

    @property
    def found(self) -> str:
        """A sentence about what the dataset has for the project."""
        number = sum(self.boxes.values())
        if self.is_3d:
            return f"{amount(number, '3D box')} in {amount(self.frames, 'frame')} of this project."
        return f"{amount(number, 'box')} on {amount(self.frames, 'image')} of this project's frames."


def preview_boxes(project: Project, path: Path, format: FlatFormat | BoxFormat, recording: str | None) -> Preview:
    """Reads a dataset and matches it with the project's frames."""
    if isinstance(format, FlatFormat):
        return _of_pictures(project, path, format, recording)
    dataset = read_labels(format, path).in_project(project)
    placed = dataset.placed(project, recording)
    names = [name for name, _ in placed.matched] + [name for name, *_ in placed.ambiguous]
    labelled, notes = project.labels.frames(), []
    finalised = sum(stored.finalised for _, stored in placed.matched)
    if worked_on := sum(stored.id in labelled and not stored.finalised for _, stored in placed.matched):
        frames = amount(worked_on, "of these frames has", "of these frames have")
        notes.append(f"{frames} labels or proposals, and can only take proposals.")
    if finalised:
        frames = amount(finalised, "of these frames is", "of these frames are")
        notes.append(f"{frames} finalised, and left unchanged.")
    boxes = Counter(label for name in names for label in dataset.classes(name))
    return _preview(True, placed, boxes, dataset.scores, notes)


def _of_pictures(project: Project, path: Path, format: FlatFormat, recording: str | None) -> Preview:
    dataset = read_pictures(format, path)
    placed = placed_pictures(project, dataset, dataset.pictures, recording)
    pictures = [picture for picture, _ in placed.matched] + [picture for picture, *_ in placed.ambiguous]
    drawn = {one.frame_id for one in project.boxes.on_images() if one.boxes and one.source is not Source.IMPORTED}
    replaced = sum(stored.id in drawn and not stored.finalised for _, stored in placed.matched)
    notes = [f"The import replaces the boxes drawn on {amount(replaced, 'image')}."] if replaced else []
    boxes = Counter(label for picture in pictures for label in picture.labels)
    return _preview(False, placed, boxes, None, notes)


def _preview(
    is_3d: bool, placed: Matched[object], boxes: Counter[str], scores: ScoreRange | None, notes: list[str]
) -> Preview:
    thing = "frame" if is_3d else "image"
    if (renamed := placed.renamed) is not None:
        notes.append(f"The file names a recording {renamed.named}, taken for {', '.join(renamed.taken_for)}.")
    if placed.unmatched:
        names = ", ".join(placed.unmatched[:MOST_NAMES])
        left_out = amount(len(placed.unmatched), thing)
        notes.append(f"Left out: {left_out} without a frame of the same name, such as {names}.")
    frames = len(placed.matched) + len(placed.ambiguous)
    return Preview(is_3d, frames, len(placed.ambiguous), dict(sorted(boxes.items())), scores, tuple(notes))
