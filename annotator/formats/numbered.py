"""What folders of numbered files with text labels need: six-digit names of frames, class names of one word, and both
back to what they mean.

KITTI's and SUN RGB-D's tools form file names from numbers (`%06d`) and split label rows at blanks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from annotator.formats.frames_csv import FRAMES_CSV, FrameOrigin, has_frames, read_frames
from annotator.formats.text_folder import read_text
from annotator.types.errors import FormatError

CLASS_NAMES = "classes.txt"
SIX_DIGITS = re.compile(r"[0-9]{6}")


def six_digit_ids(places: Sequence[tuple[str, str]], first: int = 0) -> dict[tuple[str, str], str]:
    """A name of six digits for each frame: its own key where all keys are such and differ, else a number.

    Args:
        places: recording and key of all frames, all different, in order.
        first: where counting begins.
    """
    keys = [key for _, key in places]
    if all(map(SIX_DIGITS.fullmatch, keys)) and len(set(keys)) == len(keys):
        return dict(zip(places, keys, strict=True))
    return {place: f"{number:06d}" for number, place in enumerate(places, first)}


class ClassWords:
    """Class names as single words, all different: blanks become `_`."""

    def __init__(self, classes: Iterable[str], reserved: Sequence[str] = ()) -> None:
        """Takes all class names; `reserved` words, in whatever case, mean something else in the format."""
        self._words: dict[str, str] = {}
        taken = {word.casefold() for word in reserved}
        # names that are words already keep them
        for name in sorted(classes, key=lambda name: len(name.split()) != 1):
            word = "_".join(name.split())
            while word in self._words.values() or word.casefold() in taken:
                word += "_"
            self._words[name] = word

    def __getitem__(self, name: str) -> str:
        return self._words[name]

    def is_changed(self, name: str) -> bool:
        """True where the word is not the name."""
        return self._words[name] != name

    def dump(self) -> str:
        """The text of `classes.txt`: for each changed name a line of its word, a blank and the name."""
        return "".join(f"{word} {name}\n" for name, word in self._words.items() if word != name)


def read_class_names(folder: Path) -> dict[str, str]:
    """The names behind the words that `ClassWords.dump` wrote to a dataset's `classes.txt`; empty without that file.

    Raises:
        FormatError: it cannot be read, or a line is not a word, a blank and a name.
    """
    path = folder / CLASS_NAMES
    if not path.is_file():
        return {}
    names: dict[str, str] = {}
    for line, text in enumerate(read_text(path).splitlines(), 1):
        word, _, name = text.partition(" ")
        if not word or not name.strip() or word in names:
            raise FormatError(
                path, "a line must be a word of the labels, a blank and the class name that it means", line
            )
        names[word] = name
    return names


@dataclass(frozen=True)
class Meanings:
    """What a dataset says of its frames and class words; nothing, where somebody else made it.

    Attributes:
        root: the folder with frames.csv; None without any.
        frames: by the stem of their files.
        classes: class names by their words, where they differ.
    """

    root: Path | None = None
    frames: dict[str, FrameOrigin] = field(default_factory=dict)
    classes: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, labels: Path) -> Meanings:
        """Those of the dataset that a folder of label files belongs to; its frames.csv is at most two folders above.

        Raises:
            FormatError: frames.csv or classes.txt is damaged, or two files are the same frame.
        """
        above = labels.resolve()
        root = next((folder for folder in (above, *above.parents[:2]) if has_frames(folder)), None)
        if root is None:
            return cls()
        frames, ids = read_frames(root), dict[str, str]()
        for origin in frames.values():
            if ids.setdefault(origin.name, origin.id) != origin.id:
                raise FormatError(root / FRAMES_CSV, f"{ids[origin.name]} and {origin.id} are both {origin.name}")
        return cls(root, frames, read_class_names(root))

    def frame(self, stem: str) -> str:
        """`RECORDING/KEY` of a label file; its stem where nothing is known.

        Raises:
            FormatError: frames.csv does not name it.
        """
        if self.root is None:
            return stem
        if stem not in self.frames:
            raise FormatError(self.root / FRAMES_CSV, f"does not name the frame {stem}, which has labels; add a line")
        return self.frames[stem].name

    def label(self, word: str) -> str:
        """The class name of a word."""
        return self.classes.get(word, word)
