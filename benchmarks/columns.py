"""How `.bin` scans are read whose number of values per point nothing states: made-up sets of scans, and real ones.

python -m benchmarks.columns [DATA] [--sets 200] [--seed 0] [--json]

Each set of made-up scans (`benchmarks/column_scans.py`) is a folder of 1 to 6 files of 3 to 8 columns. A set is read if
all points of all files are right, refused if a file is refused with what to do, and wrong otherwise. Files that are no
such scans (64-bit floats, columns one after the other, nine columns, noise) must be refused. With DATA, the scans of
KITTI and nuScenes below it are read where they are, and again in a folder whose name says nothing.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro

from annotator.recordings.scan_file import Scans
from annotator.types.errors import ConfigError, FrameError, UnclearError
from benchmarks.column_scans import OTHERS, make_set
from benchmarks.report import Table, finish, guarded

READ, REFUSED, WRONG = "read", "refused", "wrong"
# Content of each kind that is no scan.
OTHERS_EACH = 10
REMEDY = "give --columns"


@dataclass
class Arguments:
    """Read scans without a stated number of columns."""

    data: tyro.conf.Positional[Path | None] = None
    """Folder with real scans."""
    sets: int = 200
    """Number of made-up sets."""
    seed: int = 0
    """Seed of the first set."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def outcome(folder: Path, scans: tuple[bytes, ...], columns: int) -> str:
    """Writes the scans to a folder and reads them."""
    for number, content in enumerate(scans):
        (folder / f"{number}.bin").write_bytes(content)
    reader, results = Scans(), set()
    for number, content in enumerate(scans):
        try:
            xyz_m = reader.read(folder / f"{number}.bin").xyz_m
        except UnclearError as error:
            results.add(REFUSED if REMEDY in str(error) else WRONG)
            continue
        except FrameError:
            results.add(WRONG)
            continue
        rows = np.frombuffer(content, "<f4").reshape(-1, columns)
        # a point at (0, 0, 0) is no return
        sound = np.isfinite(rows[:, :3]).all(axis=1) & rows[:, :3].any(axis=1)
        # points whose reflectance is not finite are left out, too
        is_right = any(
            np.array_equal(xyz_m, rows[kept, :3]) for kept in (sound, sound & np.isfinite(rows[:, 3 % columns]))
        )
        results.add(READ if is_right else WRONG)
    return next(kind for kind in (WRONG, REFUSED, READ) if kind in results)


def made_up(sets: int, seed: int) -> dict[str, object]:
    """Returns the counts of the made-up sets in all and by columns, and the layout of those that were not read."""
    by_columns: dict[int, Counter[str]] = {}
    layouts: dict[str, list[str]] = {REFUSED: [], WRONG: []}
    for number in range(seed, seed + sets):
        made = make_set(number)
        with TemporaryDirectory() as folder:
            kind = outcome(Path(folder), made.scans, made.columns)
        by_columns.setdefault(made.columns, Counter())[kind] += 1
        if kind != READ:
            layouts[kind].append(f"{number}: {made.layout}")
    counts = sum(by_columns.values(), Counter[str]())
    return {
        "sets": sets,
        **{kind: counts[kind] for kind in (READ, REFUSED, WRONG)},
        "by_columns": {columns: dict(by_columns[columns]) for columns in sorted(by_columns)},
        "refused_layouts": layouts[REFUSED],
        "wrong_layouts": layouts[WRONG],
    }


def others(seed: int) -> dict[str, int]:
    """Returns how many files of each kind that is no scan were read all the same."""
    accepted = {}
    for name, make in OTHERS.items():
        with TemporaryDirectory() as folder:
            accepted[name] = sum(
                _is_read(Path(folder), make(np.random.default_rng(seed + k))) for k in range(OTHERS_EACH)
            )
    return accepted


def _is_read(folder: Path, content: bytes) -> bool:
    path = folder / "0.bin"
    path.write_bytes(content)
    try:
        Scans().read(path)
    except FrameError:
        return False
    return True


def real(data: Path) -> dict[str, dict[str, int]]:
    """Returns the counts of real scans, where they are and in a folder whose name says nothing."""
    found = {4: sorted(data.glob("kitti*/**/*.bin")), 5: sorted(data.glob("nuscenes*/**/*.bin"))}
    if not all(found.values()):
        raise ConfigError(f"{data}: has no scans below kitti*/ or nuscenes*/; give the folder of the real data sets")
    counts: dict[str, dict[str, int]] = {}
    for columns, files in found.items():
        name = "KITTI" if columns == 4 else "nuScenes"
        in_place = sum(_has_points(file, columns) for file in files)
        with TemporaryDirectory() as folder:
            alone = Counter(outcome(Path(folder), (file.read_bytes(),), columns) for file in files)
        counts[name] = {"scans": len(files), "read in place": in_place, **{f"{k} alone": n for k, n in alone.items()}}
    return counts


def _has_points(file: Path, columns: int) -> bool:
    rows = np.frombuffer(file.read_bytes(), "<f4").reshape(-1, columns)
    return bool(np.array_equal(Scans().read(file).xyz_m, rows[rows[:, :3].any(axis=1), :3]))


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    if not 1 <= args.sets <= 100_000:
        raise ConfigError("--sets must be 1 to 100000")
    sets, accepted = made_up(args.sets, args.seed), others(args.seed)
    table = Table("scans", READ, REFUSED, WRONG)
    table.add(f"{args.sets} made-up sets", *(sets[kind] for kind in (READ, REFUSED, WRONG)))
    of_others = OTHERS_EACH * len(OTHERS)
    table.add(f"{of_others} files that are no scans", 0, of_others - sum(accepted.values()), sum(accepted.values()))
    result: dict[str, object] = {"made_up": sets, "others_read": accepted}
    if args.data is not None:
        result["real"] = counts = real(args.data)
        for name, row in counts.items():
            table.add(f"{row['scans']} of {name}, alone", *(row.get(f"{k} alone", 0) for k in (READ, REFUSED, WRONG)))
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
