"""Names in KITTI's and SUN RGB-D's folders: six-digit frame names, one-word class names, and the names they stand for.

The tools of both data sets form file names from numbers (`%06d`) and split label rows at spaces.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, has_frames, read_frames
from annotator.formats.text_folder import read_text
from annotator.text import normal
from annotator.types.errors import FormatError

CLASS_NAMES = "classes.txt"
SIX_DIGITS = re.compile(r"[0-9]{6}")


def six_digit_ids(places: Sequence[tuple[str, str]], first: int = 0) -> dict[tuple[str, str], str]:
    """Returns a six-digit name for each frame: its key if all keys have six digits and differ, else its number.

    Args:
        places: recording and key of all frames, all different, in order.
        first: the first number.
    """
    keys = [key for _, key in places]
    if all(map(SIX_DIGITS.fullmatch, keys)) and len(set(keys)) == len(keys):
        return dict(zip(places, keys, strict=True))
    return {place: f"{number:06d}" for number, place in enumerate(places, first)}


class ClassWords:
    """Class names as unique single words: spaces become `_`."""

    def __init__(self, classes: Iterable[str], reserved: Sequence[str] = ()) -> None:
        """
        Args:
            classes: all class names.
            reserved: words with another meaning in the format, in any case.
        """
        self._words: dict[str, str] = {}
        taken = {word.casefold() for word in reserved}
        # single words come first, so that they stay unchanged
        for name in sorted(classes, key=lambda name: len(name.split()) != 1):
            word = "_".join(name.split())
            while word in self._words.values() or word.casefold() in taken:
                word += "_"
            self._words[name] = word

    def __getitem__(self, name: str) -> str:
        return self._words[name]

    def is_changed(self, name: str) -> bool:
        """True if the word differs from the name."""
        return self._words[name] != name

    def dump(self) -> str:
        """Returns the text of `classes.txt`: one line `WORD NAME` for each changed name."""
        return "".join(f"{word} {name}\n" for name, word in self._words.items() if word != name)


def read_class_names(folder: Path) -> dict[str, str]:
    """Returns the class names in a dataset's `classes.txt` (`ClassWords.dump`), by word; empty without that file.

    Raises:
        FormatError: the file cannot be read, or a line is not a word, a space and a name, or repeats a word.
    """
    path = folder / CLASS_NAMES
    if not path.is_file():
        return {}
    names: dict[str, str] = {}
    for line, text in enumerate(read_text(path).splitlines(), 1):
        word, _, name = text.partition(" ")
        if not word or not name.strip() or word in names:
            raise FormatError(path, "a line must be `WORD CLASS_NAME`, with each word only once", line)
        names[word] = name
    return names


@dataclass(frozen=True)
class DatasetNames:
    """The frame and class names of an exported dataset; empty for datasets from other software.

    Attributes:
        root: the folder with frames.csv; None without that file.
        frames: the frames' origins by the `normal` stem of their files.
        classes: class names by word, where the two differ.
    """

    root: Path | None = None
    frames: dict[str, FrameOrigin] = field(default_factory=dict)
    classes: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, labels: Path) -> DatasetNames:
        """Reads the names of the dataset that a folder of label files belongs to.

        Its frames.csv is in that folder or at most two levels above.

        Raises:
            FormatError: frames.csv or classes.txt is damaged, or two ids have the same origin.
        """
        above = labels.resolve()
        root = next((folder for folder in (above, *above.parents[:2]) if has_frames(folder)), None)
        if root is None:
            return cls()
        frames, ids = read_frames(root), dict[str, str]()
        for origin in frames.values():
            if ids.setdefault(origin.name, origin.id) != origin.id:
                raise FormatError(
                    root / FRAMES_CSV, f"the ids {ids[origin.name]} and {origin.id} both name {origin.name}; keep one"
                )
        return cls(root, frames, read_class_names(root))

    def frame(self, stem: str) -> str:
        """Returns `RECORDING/KEY` of a label file; its `normal` stem without a frames.csv.

        Raises:
            FormatError: frames.csv does not list it.
        """
        stem = normal(stem)
        if self.root is None:
            return stem
        if stem not in self.frames:
            raise FormatError(
                self.root / FRAMES_CSV, f"does not list the frame {stem}, which has labels; add a line for this frame"
            )
        return self.frames[stem].name

    def label(self, word: str) -> str:
        """Returns the class name of a word."""
        return self.classes.get(word, word)
