"""Writes known numbers in other ways, and reports what is read wrong in silence (`scripts/fuzz values`).

The rule: the numbers that come out equal those that went in, within the format's precision, or the files are refused
(AnnotatorError); nothing else. First the plain files must give the known numbers, then the mutated ones what the plain
ones give. `test_small_recordings.py` tries pictures of many bits, `test_cloud_files.py` saturated coordinates.

A mutation that nobody could see in the files is no fault of a reader, and is counted apart as ambiguous:

degrees     unless an angle that is written exceeds 3 pi, as in radians of no program.
quaternion  unless a box is tilted by more than 10 degrees, as on no slope, in a format whose boxes are upright. Those
            of OpenLABEL, and of annotator's own exports, may be tilted.
others      if the files have nothing to change: no text, or no path.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import sys
import tempfile
import time
import unicodedata
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent.parent)]

import search  # noqa: E402, F401, I001  first: it names the folders of the samples
import numpy as np  # noqa: E402
from known_numbers import TARGETS, Numbers, Reading, Target  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from annotator.formats.reading import MOST_RAD  # noqa: E402
from annotator.types.errors import AnnotatorError  # noqa: E402

TILTED_RAD = np.radians(10)
# KITTI rounds to centimetres; all hold what is written.
KNOWN, SAME = 0.05, 3e-4
# of 255 levels, for rounding
LEVELS = {"image": 2.0, "colours": 2.0}
KINDS = ("equal", "refused", "ambiguous", "silent")


def no_points(value: float, n: Numbers, draw: random.Random) -> Numbers:
    """Rows that are no returns: one of their coordinates, or all, are `value`."""
    odd = np.array([draw.choice(n.xyz_m) for _ in range(draw.randint(1, 20))])
    odd[:, draw.choice((slice(None), 0, 1, 2))] = value
    return replace(n, odd_m=odd)


def on_map(n: Numbers, draw: random.Random, zeros: int = 0) -> Numbers:
    """Coordinates of a map, such as UTM, with rows of zeros: how some drivers write rays without a return."""
    origin = np.round([draw.uniform(2e5, 8e5), draw.uniform(4e6, 6e6), draw.uniform(0, 500)])
    return replace(n, origin_m=origin, odd_m=np.zeros((zeros, 3)))


def as_(**changes: Any) -> Callable[[Numbers, random.Random], Numbers]:
    return lambda n, _: replace(n, **changes)


WAYS: dict[str, Callable[[Numbers, random.Random], Numbers]] = {
    "nan": lambda n, draw: no_points(np.nan, n, draw),
    "inf": lambda n, draw: no_points(np.inf, n, draw),
    "map": on_map,
    "map_zero": lambda n, draw: on_map(n, draw, draw.randint(1, 9)),
    **{kind: as_(colours=kind) for kind in ("words", "floats", "float_bytes")},
    **{f"share_{kind}": as_(shares=kind) for kind in ("bytes", "words")},
    **{f"hole_{value}": as_(hole=float(value)) for value in ("nan", "inf", "-inf", "-1", "65504", "65535")},
}


# not the points in names and versions
NUMBER = re.compile(r"(?<![\w./-])(-?\d+)\.(\d+)(?![\w.]*[./\w])")
TEXTS: dict[str, Callable[[str], bytes]] = {
    "byte_order_mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "line_ends": lambda text: text.replace("\n", "\r\n").encode(),
    "utf_16": lambda text: text.encode("utf-16"),
    "decimal_comma": lambda text: NUMBER.sub(r"\1,\2", text).encode(),
    "blank_end": lambda text: f"{text.rstrip()} \n\n".encode(),
}


def texts(folder: Path) -> list[Path]:
    """The text files below a folder."""
    contents = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    return sorted(file for file, content in contents.items() if b"\0" not in content and content.isascii())


def rewrite(mutation: str, folder: Path, draw: random.Random) -> str:
    """Writes one text file in another way, or all of them."""
    found = texts(folder)
    for file in draw.choice(([draw.choice(found)], found)) if found else ():
        file.write_bytes(TEXTS[mutation](file.read_text()))
    return "" if found else "no text"


def changed_json(file: Path, change: Callable[[str, Any], Any]) -> None:
    """Replaces values: `change(key, value)`."""

    def walk(key: str, value: Any) -> Any:
        new = change(key, value)
        if isinstance(new, dict):
            return {each: walk(each, part) for each, part in new.items()}
        return [walk("", part) for part in new] if isinstance(new, list) else new

    file.write_text(json.dumps(walk("", json.loads(file.read_text()))))


def degrees(folder: Path, _: random.Random) -> str:
    """Angles in degrees in place of radians: of SUSTechPOINTS, of KITTI's rows, and of CSV."""
    written: list[float] = []

    def turned(value: str | float) -> float:
        written.append(float(np.degrees(float(value))))
        return written[-1]

    def of_json(key: str, value: Any) -> Any:
        return {axis: turned(angle) for axis, angle in value.items()} if key == "rotation" else value

    for file in texts(folder):
        if file.name == "0.json":
            changed_json(file, of_json)
        elif file.name == "out.csv" or file.parent.name.startswith("label"):
            mark = "," if file.suffix == ".csv" else " "
            rows = [line.split(mark) for line in file.read_text().splitlines()]
            for row in rows[file.suffix == ".csv" :]:
                # rows of tracking begin with the frame and the track
                place = 8 if file.suffix == ".csv" else 16 if row[0].isdigit() else 14
                row[place] = repr(turned(row[place]))
            file.write_text("".join(mark.join(row) + "\n" for row in rows))
    return "" if max(map(abs, written)) > MOST_RAD else "no angle exceeds 3 pi"


def quaternion(folder: Path, _: random.Random) -> str:
    """Boxes' quaternions with w last in place of first (nuScenes), or first in place of last (OpenLABEL)."""
    tilts: list[float] = []

    def moved(key: str, value: Any) -> Any:
        count = len(value) if isinstance(value, list) else 0
        if key == "val" and count == 10:
            return [*value[:3], value[6], *value[3:6], *value[7:]]
        if key == "rotation" and count == 4:
            up = Rotation.from_quat([*value[1:], value[0]], scalar_first=True).as_matrix()[2, 2]
            tilts.append(float(np.arccos(min(abs(up), 1.0))))
            return [*value[1:], value[0]]
        return value

    for file in texts(folder):
        if file.name == "instance.json":  # as of other programs than annotator
            rows = json.loads(file.read_text())
            file.write_text(json.dumps([{key: row[key] for key in row if key != "track_id"} for row in rows]))
        elif file.name == "sample_annotation.json" or '"openlabel"' in file.read_text()[:100]:
            changed_json(file, moved)
    return "" if max(tilts, default=0.0) > TILTED_RAD else "no box is tilted that must not be"


def backslash(folder: Path, _: random.Random) -> str:
    """Paths with backslashes, as on Windows."""
    path, changed = re.compile(r"[\w.-]+(?:/[\w.-]+)+\.(?:png|bin)"), 0
    for file in texts(folder):
        mark = r"\\" if file.suffix == ".json" else "\\"
        text, count = path.subn(lambda found, mark=mark: found[0].replace("/", mark), file.read_text())  # type: ignore[misc]
        file.write_text(text)
        changed += count
    return "" if changed else "no path"


def nfd(folder: Path, draw: random.Random) -> str:
    """The same name, composed and decomposed: some of the files' names, and the texts that name them."""
    forms = ["NFC", "NFD"]
    draw.shuffle(forms)
    for number, file in enumerate(sorted(file for file in folder.rglob("*.*") if file.stem in ("0", "a"))):
        file.rename(file.with_name(unicodedata.normalize(forms[number % 2], f"Bü{file.name}")))
    for file in texts(folder):
        name = unicodedata.normalize(draw.choice(forms), r"Bü\1")
        file.write_text(re.sub(r"(?<![\w.])(a\.png|0(?=,))", name, file.read_text()), encoding="utf-8")
    return ""


EDITS: dict[str, Callable[[Path, random.Random], str]] = {
    "degrees": degrees,
    "quaternion": quaternion,
    "backslash": backslash,
    "nfd": nfd,
}


def mutations(target: Target) -> list[str]:
    """All that a target is tried with."""
    return ["plain", *target.ways, *target.edits, *TEXTS]


def difference(want: Reading, have: Reading, tolerance: float) -> str:
    """The first difference in words; "" if all numbers of `want` are there."""
    for name, numbers in want.items():
        other = have.get(name, np.zeros(0))
        if other.shape != numbers.shape:
            return f"{name}: {numbers.shape} became {other.shape}"
        off = np.abs(numbers.astype(np.float64) - other)
        worst = np.unravel_index(int(np.argmax(np.nan_to_num(off, nan=np.inf))), off.shape)
        if not off[worst] <= LEVELS.get(name, tolerance):
            return f"{name}: {numbers[worst]:.6g} became {other[worst]:.6g}"
    return ""


def case(target: Target, mutation: str, seed: str, keep: Path | None = None) -> tuple[str, str]:
    """Tries a mutation: returns one of `KINDS`, and the difference or the refusal; `keep`s what is read wrong."""
    draw = random.Random(seed)
    numbers = Numbers.drawn(draw)
    with tempfile.TemporaryDirectory() as place:
        # TUM's folders are known by their names
        plain, other = Path(place) / "plain_freiburg", Path(place) / "other_freiburg"
        for folder, way in ((plain, None), (other, WAYS.get(mutation))):
            folder.mkdir()
            target.write(folder, way(numbers, draw) if way else numbers)
        want = target.read(plain)
        known = numbers.known()
        found = difference({name: known[name] for name in target.known}, want, KNOWN)
        if found or mutation == "plain":
            return ("silent", f"plain: {found}") if found else ("equal", "")
        change = EDITS.get(mutation) or (
            lambda folder, draw: rewrite(mutation, folder, draw) if mutation in TEXTS else ""
        )
        if why := change(other, draw):
            return "ambiguous", why
        try:
            have = target.read(other)
        except AnnotatorError as error:
            return "refused", str(error).replace(place, "")
        except Exception as error:
            found = f"raises {type(error).__name__}: {error}"
        else:
            if mutation == "map_zero":  # of the raw file, which has the zeros
                want.pop("reflectances", None)
            found = difference(want, have, SAME)
        if found and keep:
            shutil.copytree(other, keep / f"{target.name} {mutation} {seed.split()[-1]}", dirs_exist_ok=True)
    return ("silent", found) if found else ("equal", "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=500, help="cases of each target, its mutations in turn")
    parser.add_argument("--only", default="", help="targets whose name contains this")
    parser.add_argument("--keep", type=Path, help="folder for the files that were read wrong")
    given = parser.parse_args()
    began, total = time.monotonic(), Counter[str]()
    for target in (each for each in TARGETS if given.only in each.name):
        kinds, silent = Counter[str](), list[str]()
        for number in range(given.count):
            mutation = mutations(target)[number % len(mutations(target))]
            kind, what = case(target, mutation, f"{given.seed} {target.name} {number}", given.keep)
            kinds[kind] += 1
            silent += [f"    {mutation}, number {number}: {what}"] if kind == "silent" else []
        total += kinds
        counts = ", ".join(f"{kinds[kind]:4} {kind}" for kind in KINDS)
        print("\n".join([f"{target.name:24} {counts}", *silent]), flush=True)
    took_s, found = time.monotonic() - began, total["silent"]
    print(f"{total.total()} cases, seed {given.seed}: {found} silent differences; {took_s:.0f} s")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
