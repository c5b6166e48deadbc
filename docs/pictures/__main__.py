"""Makes the pictures of the documentation again: `python docs/pictures [NAME ...]`, by default all.

Needs the base detector, the `test` extra and Chromium, and some ten minutes.

`python docs/pictures cold_start FOLDER [DATA]` draws the curves of docs/cold_start.md, and fills its table.
FOLDER keeps the results; those that are missing are measured on the recordings in DATA.

`python docs/pictures pages FOLDER [NAME ...]` writes screenshots of every page, which are not of the documentation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cold_start
import gallery
import guide
import method
import moving
import pages

MAKERS = {
    "method": method.main,
    "moving": moving.main,
    "guide": guide.main,
    "calibration": guide.calibration,
    "statistics": guide.statistics,
    "gallery": gallery.main,
}


def main(words: list[str]) -> None:
    """
    Raises:
        SystemExit: unknown names.
    """
    if words[:1] == ["cold_start"]:
        if len(words) not in (2, 3):
            sys.exit("usage: python docs/pictures cold_start FOLDER [DATA]")
        cold_start.main(Path(words[1]), *map(Path, words[2:]))
        return
    if words[:1] == ["pages"]:
        if len(words) < 2:
            sys.exit("usage: python docs/pictures pages FOLDER [NAME ...]")
        pages.main(Path(words[1]), words[2:])
        return
    unknown = set(words) - set(MAKERS)
    if unknown:
        sys.exit(f"no such picture: {', '.join(sorted(unknown))}; choose from {', '.join(MAKERS)}")
    # the guide's pictures include those of `calibration` and `statistics`
    for name in words or [name for name in MAKERS if name not in ("calibration", "statistics")]:
        sys.stderr.write(f"{name} ...\n")
        MAKERS[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
