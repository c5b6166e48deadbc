"""What folders of numbered files with text labels need: six-digit names of frames, and class names of one word.

KITTI's and SUN RGB-D's tools form file names from numbers (`%06d`) and split label rows at blanks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

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
