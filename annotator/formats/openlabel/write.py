"""Writes a folder of OpenLABEL documents with their images and clouds, one frame in memory at a time.

    [PART/]RECORDING.json   one document per recording
    [PART/]images/ID.png    the camera images (or .jpg)
    [PART/]clouds/ID.ply    the clouds, camera frame
    frames.csv              the origin of each frame

There is one document per recording because frame numbers and object identities are valid within one document: readers
treat a file as one scene with one set of sensors. Each part of a divided dataset is a folder of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from annotator.files import new_folder, open_file
from annotator.formats.dataset_writing import DatasetItem, FileNames, FrameIds, encoded_image, writing
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.openlabel.model import Document
from annotator.formats.openlabel.scene import Scene
from annotator.formats.ply import write_ply
from annotator.types.errors import FormatError

# Exported documents have the key "openlabel" within these first bytes.
_HEAD_BYTES = 64


def write_openlabel(
    out: Path,
    items: Iterable[DatasetItem],
    generator: str,
    image_format: Literal["png", "jpg"] = "png",
    *,
    comment: str | None = None,
    losses: Losses | None = None,
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Writes the folder `out` atomically and returns the number of objects of each class.

    Args:
        items: the frames, read one by one; if reading one raises, `out` is unchanged.
        generator: program and version.
        comment: about the boxes, for the metadata of each document.
        losses: counts what the format cannot store; None: not counted.
        overwrite: replace an older export of this format.

    Raises:
        FormatError: `out` exists, there is no frame, a frame occurs twice, or writing fails.
    """
    scenes: dict[tuple[str | None, str], Scene] = {}
    ids, origins, objects = FrameIds(), [], Counter[str]()
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        for item in items:
            if losses is not None:
                count_lost(losses, item, (Lost.GRAVITY,))
            frame_id = ids.add(out, item)
            scene = scenes.setdefault((item.split, item.recording), Scene(item.recording, generator, comment))
            image, cloud = f"images/{frame_id}.{image_format}", f"clouds/{frame_id}.ply"
            with writing(out):
                folder = part / (item.split or "")
                for name in ("images", "clouds"):
                    (folder / name).mkdir(parents=True, exist_ok=True)
                (folder / image).write_bytes(encoded_image(item.frame.rgb, image_format))
                write_ply(folder / cloud, item.frame.cloud)
            scene.add(item, image, cloud)
            origins.append(FrameOrigin(frame_id, item.recording, item.frame.key, item.split))
            objects.update(label.label for label in item.labels)
        if not origins:
            raise FormatError(out, "there is no frame to export; the export was not written")
        with writing(out):
            (part / FRAMES_CSV).write_text(dump_frames(origins), encoding="utf-8", newline="")
            for name, scene in _named(scenes).items():
                (part / name).write_text(dump(scene.document()), encoding="utf-8")
    return objects


def dump(document: Document) -> str:
    """Returns the text of a document."""
    return document.model_dump_json(indent=1, exclude_none=True) + "\n"


def _named(scenes: Mapping[tuple[str | None, str], Scene]) -> dict[str, Scene]:
    """Returns the documents by their path within the dataset; a recording has the same file name in all parts."""
    names = FileNames()
    stems = {recording: names.add(recording) for recording in dict.fromkeys(recording for _, recording in scenes)}
    return {f"{split or '.'}/{stems[recording]}.json": scene for (split, recording), scene in scenes.items()}


def _is_dataset(folder: Path) -> bool:
    """True for an export of annotator; no other folder is overwritten."""
    if not (folder / FRAMES_CSV).is_file():
        return False
    documents = [*folder.glob("*.json"), *folder.glob("*/*.json")]
    return bool(documents) and all(_is_document(path) for path in documents)


def _is_document(path: Path) -> bool:
    with open_file(path) as stream:
        return b'"openlabel"' in stream.read(_HEAD_BYTES)
