"""Writes an `rcv` dataset, one frame in memory at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from annotator.files import TABLE_BYTES, new_folder, read_text_file
from annotator.formats.dataset_writing import DatasetItem, FrameIds, encoded_image, writing
from annotator.formats.ply import write_ply
from annotator.formats.rcv.convert import camera_record, labels_record
from annotator.formats.rcv.model import (
    FORMAT_NAME,
    FORMAT_VERSION,
    RcvCamera,
    RcvCameraUse,
    RcvConventions,
    RcvCounts,
    RcvDetector,
    RcvManifest,
    RcvOptions,
)
from annotator.formats.rcv.readme import readme_text
from annotator.types import ReviewState, Source
from annotator.types.errors import FormatError

MANIFEST = "dataset.json"
FOLDERS = ("images", "clouds", "labels")
SPLITS = "splits"


@dataclass(frozen=True)
class RcvInfo:
    """Data about an export, written to its manifest.

    Attributes:
        classes: all class names of the project, in its order; every label must be one of them.
        detectors: the detectors that contributed to the boxes.
        generator: program and version, such as "annotator 0.1.0".
        options: how images are written.
    """

    classes: tuple[str, ...]
    detectors: tuple[RcvDetector, ...]
    generator: str
    options: RcvOptions = field(default_factory=RcvOptions)


def export_rcv(out: Path, items: Iterable[DatasetItem], info: RcvInfo, *, overwrite: bool = False) -> RcvManifest:
    """Writes the dataset folder `out` atomically and returns the content of its `dataset.json`.

    Args:
        out: a folder that is missing or empty; with `overwrite`, an older rcv dataset is replaced.
        items: the frames, read one by one; if reading one raises, `out` is unchanged.
        info: classes, detectors, generator, options.

    Raises:
        FormatError: `out` exists, there is no frame, a frame occurs twice, a label has an unknown class, or writing
            fails.
    """
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        tally = _Tally()
        with writing(out):
            for name in FOLDERS:
                (part / name).mkdir()
        for item in items:
            _require_classes(out, item, info.classes)
            frame_id = tally.add(out, item)
            with writing(out):
                _write_frame(part, frame_id, item, info.options)
        if not tally.ids.ids:
            raise FormatError(out, "there is no frame to export; the export was not written")
        manifest = tally.manifest(info)
        with writing(out):
            (part / "README.md").write_text(readme_text(manifest), encoding="utf-8")
            (part / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
            _write_splits(part, tally.splits)
    return manifest


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator; no other folder is overwritten."""
    manifest = folder / MANIFEST
    return manifest.is_file() and f'"{FORMAT_NAME}"' in read_text_file(manifest, TABLE_BYTES, errors="replace")


def _require_classes(out: Path, item: DatasetItem, classes: tuple[str, ...]) -> None:
    for label in item.labels:
        if label.label not in classes:
            where = f"{item.recording}, frame {item.frame.key}"
            raise FormatError(out, f"{where}: label {label.label!r} is not one of the classes {', '.join(classes)}")


def _write_frame(part: Path, frame_id: str, item: DatasetItem, options: RcvOptions) -> None:
    """Writes the frame's three files."""
    image, cloud = f"images/{frame_id}.{options.image_format}", f"clouds/{frame_id}.ply"
    (part / image).write_bytes(encoded_image(item.frame.rgb, options.image_format, options.jpeg_quality))
    write_ply(part / cloud, item.frame.cloud)
    record = labels_record(frame_id, item.recording, item.frame, item.labels, image, cloud, item.attributes)
    (part / f"labels/{frame_id}.json").write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")


def _write_splits(part: Path, splits: Mapping[str, Sequence[str]]) -> None:
    """Writes the ids of each part of a divided dataset, one per line."""
    for name, ids in splits.items():
        (part / SPLITS).mkdir(exist_ok=True)
        (part / SPLITS / f"{name}.txt").write_text("".join(f"{each}\n" for each in ids), encoding="utf-8")


@dataclass
class _Tally:
    """Ids and counts of the frames so far."""

    ids: FrameIds = field(default_factory=FrameIds)
    splits: dict[str, list[str]] = field(default_factory=dict)
    cameras: dict[RcvCamera, list[str]] = field(default_factory=dict)
    points: int = 0
    by_recording: Counter[str] = field(default_factory=Counter)
    objects_by_recording: Counter[str] = field(default_factory=Counter)
    objects_by_class: Counter[str] = field(default_factory=Counter)
    objects_by_state: Counter[ReviewState] = field(default_factory=Counter)
    objects_by_source: Counter[Source] = field(default_factory=Counter)

    def add(self, out: Path, item: DatasetItem) -> str:
        """Counts the frame and returns its id."""
        frame_id = self.ids.add(out, item)
        if item.split is not None:
            self.splits.setdefault(item.split, []).append(frame_id)
        recordings = self.cameras.setdefault(camera_record(item.frame.camera), [])
        if item.recording not in recordings:
            recordings.append(item.recording)
        self.points += len(item.frame.cloud)
        self.by_recording[item.recording] += 1
        self.objects_by_recording[item.recording] += len(item.labels)
        self.objects_by_class.update(label.label for label in item.labels)
        self.objects_by_state.update(label.state for label in item.labels)
        self.objects_by_source.update(label.source for label in item.labels)
        return frame_id

    def manifest(self, info: RcvInfo) -> RcvManifest:
        return RcvManifest(
            format=FORMAT_NAME,
            version=FORMAT_VERSION,
            generator=info.generator,
            classes=info.classes,
            conventions=RcvConventions(),
            detectors=info.detectors,
            options=info.options,
            cameras=tuple(RcvCameraUse(camera=c, recordings=tuple(names)) for c, names in self.cameras.items()),
            counts=RcvCounts(
                frames=len(self.ids.ids),
                objects=sum(self.objects_by_class.values()),
                points=self.points,
                frames_by_recording=dict(self.by_recording),
                objects_by_recording=dict(self.objects_by_recording),
                objects_by_class={name: self.objects_by_class[name] for name in info.classes},
                objects_by_state={state: self.objects_by_state[state] for state in ReviewState},
                objects_by_source={source: self.objects_by_source[source] for source in Source},
            ),
            frames=tuple(self.ids.ids.values()),
        )
