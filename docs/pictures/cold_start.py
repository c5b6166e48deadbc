"""The curves and the table of docs/cold_start.md, from `benchmarks.cold_start`.

FOLDER/NAME.json has the results on the second half of a recording, after 0, 1, 5 and 20 taught objects of each class.
With a folder of recordings, missing files are measured first; delete the files if the base detector has changed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from annotator.files import write_atomic

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TAUGHT = (0, 1, 5, 20)
# What a person draws to teach an object: only the box on the image, if the suggested ones are right, or all five.
FEWEST_DRAGS, MOST_DRAGS = 1, 5
# The recordings with 3D boxes, and the options of the benchmark.
RECORDINGS: dict[str, tuple[str, ...]] = {
    "hand_gesture": ("--free",),
    "human_turn": ("--upright",),
    "kitti": ("--upright",),
    "kitti_drive_0005": ("--upright",),
    "sunrgbd/sunrgbd_trainval": (),
}
CLUSTERS = " (clusters)"
# A class with fewer objects is in the tables, but has no curve.
LEAST_OBJECTS = 5
FIGURES = (("mean_iou", "mean IoU"), ("recall_50", "share with IoU ≥ 0.5"))


@dataclass(frozen=True)
class Row:
    """The result for the objects of a class after some number of taught ones.

    Attributes:
        mean_iou, recall_50: mean IoU, and share of the objects with an IoU of at least 0.5.
    """

    objects: int
    mean_iou: float
    recall_50: float

    @property
    def cell(self) -> str:
        """Its text in a table."""
        return f"{self.mean_iou:.2f} ({self.recall_50:.2f})"


# By recording, class, and number of taught objects (None: the guess from clusters).
Results = Mapping[str, Mapping[str, Mapping[int | None, Row]]]


def main(folder: Path, data: Path | None = None) -> None:
    """
    Args:
        folder: of the result files.
        data: the folder of the recordings; None = only the results that exist.
    """
    if data is not None:
        for name, options in RECORDINGS.items():
            measure(data / name, options, folder / f"{Path(name).name}.json")
    curves(read_results(folder), DOCS / "cold_start.svg")
    replace_table(DOCS / "cold_start.md", taught_table(read_results(folder)))


def measure(recording: Path, options: tuple[str, ...], out: Path) -> None:
    """Runs the benchmark, unless its result exists.

    Raises:
        CalledProcessError: the benchmark fails; it has said why.
    """
    if out.exists():
        return
    numbers = [str(number) for number in TAUGHT]
    command = [
        sys.executable,
        "-m",
        "benchmarks.cold_start",
        str(recording.resolve()),
        *options,
        "--minutes",
        "1.5",
        "--taught",
        *numbers,
    ]
    ran = subprocess.run([*command, "--json"], cwd=ROOT, stdout=subprocess.PIPE, check=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(out, ran.stdout.splitlines()[-1] + b"\n")


def read_results(folder: Path) -> Results:
    """Reads the result files of a folder; the recordings are named like the files."""
    results: dict[str, dict[str, dict[int | None, Row]]] = {}
    for path in sorted(folder.glob("*.json")):
        classes: dict[str, dict[int | None, Row]] = {}
        for row in json.loads(path.read_text(encoding="utf-8"))["results"]:
            label = row["label"].removesuffix(CLUSTERS)
            taught = None if row["label"].endswith(CLUSTERS) else row["taught"]
            classes.setdefault(label, {})[taught] = Row(row["objects"], row["mean_iou"], row["recall_50"])
        results[path.stem] = classes
    return results


def taught_table(results: Results) -> list[str]:
    """The lines of the table, with a row for each class; "–" where nothing was measured."""
    heads = ["recording", "class", "objects", "clusters", *(f"{number} taught" for number in TAUGHT)]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for recording, classes in results.items():
        for label, rows in classes.items():
            cells = [rows[key].cell if key in rows else "–" for key in (None, *TAUGHT)]
            objects = next(iter(rows.values())).objects
            lines.append("| " + " | ".join([recording, label, str(objects), *cells]) + " |")
    return lines


def replace_table(document: Path, lines: list[str]) -> None:
    """Replaces the text between a document's two markers.

    Raises:
        ValueError: there are no such markers.
    """
    begin, end = "<!-- results: begin -->\n", "<!-- results: end -->\n"
    before, found, rest = document.read_text(encoding="utf-8").partition(begin)
    _, found_too, after = rest.partition(end)
    if not (found and found_too):
        raise ValueError(f"{document.name} has no line {(begin if not found else end).strip()!r}")
    text = before + begin + "\n".join(lines) + "\n" + end + after
    write_atomic(document, text.encode())


def curves(results: Results, path: Path) -> None:
    """Draws a column of diagrams for each recording, with a line for each class and a dotted one for its clusters."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    # the same file from the same results
    matplotlib.rcParams |= {"svg.hashsalt": "cold_start", "svg.fonttype": "none", "font.size": 9.0}
    shown = {
        name: {label: rows for label, rows in classes.items() if 0 in rows and rows[0].objects >= LEAST_OBJECTS}
        for name, classes in results.items()
    }
    shown = {name: classes for name, classes in shown.items() if classes}
    size = (2.6 * len(shown) + 0.6, 5.2)
    figure, axes = pyplot.subplots(2, len(shown), figsize=size, sharex=True, sharey=True, squeeze=False)
    for column, (name, classes) in enumerate(shown.items()):
        axes[0, column].set_title(name, fontsize=10)
        for row, (figure_name, _) in enumerate(FIGURES):
            for number, (label, rows) in enumerate(classes.items()):
                at = [place for place, taught in enumerate(TAUGHT) if taught in rows]
                values = [getattr(rows[TAUGHT[place]], figure_name) for place in at]
                axes[row, column].plot(at, values, color=f"C{number}", marker="o", markersize=4, label=label)
                if None in rows:
                    guess = getattr(rows[None], figure_name)
                    axes[row, column].axhline(guess, color=f"C{number}", linestyle=":", linewidth=1)
            axes[row, column].grid(alpha=0.3)
        axes[0, column].legend(fontsize=8, loc="lower right")
        axes[1, column].set_xticks(range(len(TAUGHT)), [f"{number}\n{drags(number)}" for number in TAUGHT])
        axes[1, column].set_xlim(-0.2, len(TAUGHT) - 0.8)
        axes[1, column].set_xlabel("objects taught, and drags for them")
    for row, (_, text) in enumerate(FIGURES):
        axes[row, 0].set_ylabel(text)
        axes[row, 0].set_ylim(0, 1.02)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)


def drags(taught: int) -> str:
    """How many 2D boxes a person draws to teach so many objects."""
    return "0" if taught == 0 else f"{FEWEST_DRAGS * taught}–{MOST_DRAGS * taught}"
