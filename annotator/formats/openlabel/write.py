"""Writes a folder of OpenLABEL documents with their images and clouds, one frame in memory at a time.

    [PART/]RECORDING.json   one document a recording
    [PART/]images/ID.png    the camera images (or .jpg)
    [PART/]clouds/ID.ply    the clouds, camera frame
    frames.csv              where each frame came from

A document is one recording because OpenLABEL counts frames, and knows an object again, within one document: readers
take a file as one scene with one set of sensors. Divided, each part of the dataset is a folder of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from annotator.files import new_folder
from annotator.formats.dataset import DatasetItem, FileNames, FrameIds
from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, dump_frames
from annotator.formats.losses import Losses, Lost, count_lost
from annotator.formats.openlabel.model import Document
from annotator.formats.openlabel.scene import Scene
from annotator.formats.ply import write_ply
from annotator.formats.writing import encoded_image, writing
from annotator.types.errors import FormatError

# A document of ours says so in its first bytes.
_HEAD_BYTES = 64


def write_openlabel(
    out: Path,
    items: Iterable[DatasetItem],
    generator: str,
    image_format: Literal["png", "jpg"] = "png",
    *,
    losses: Losses | None = None,
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Writes the folder `out`, all or not at all, and returns the number of objects of each class.

    Args:
        items: the frames, read one by one; an error from here leaves nothing behind.
        generator: program and version.
        losses: what the format does not hold is counted here, where somebody asks.
        overwrite: an older dataset of this format may be replaced.

    Raises:
        FormatError: `out` is taken, there is no frame, one comes twice, or the disk refuses.
    """
    scenes: dict[tuple[str | None, str], Scene] = {}
    ids, origins, objects = FrameIds(), [], Counter[str]()
    with new_folder(out, lambda folder: overwrite and _is_dataset(folder)) as part:
        for item in items:
            if losses is not None:
                count_lost(losses, item, (Lost.GRAVITY,))
            frame_id = ids.add(out, item)
            scene = scenes.setdefault((item.split, item.recording), Scene(item.recording, generator))
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
    """The text of a document."""
    return document.model_dump_json(indent=1, exclude_none=True) + "\n"


def _named(scenes: Mapping[tuple[str | None, str], Scene]) -> dict[str, Scene]:
    """The documents by their places within the dataset; a recording has one name in all parts."""
    names = FileNames()
    stems = {recording: names.add(recording) for recording in dict.fromkeys(recording for _, recording in scenes)}
    return {f"{split or '.'}/{stems[recording]}.json": scene for (split, recording), scene in scenes.items()}


def _is_dataset(folder: Path) -> bool:
    """True for a former export: no other folder is ever overwritten."""
    if not (folder / FRAMES_CSV).is_file():
        return False
    documents = [*folder.glob("*.json"), *folder.glob("*/*.json")]
    return bool(documents) and all(_is_document(path) for path in documents)


def _is_document(path: Path) -> bool:
    with path.open("rb") as stream:
        return b'"openlabel"' in stream.read(_HEAD_BYTES)
