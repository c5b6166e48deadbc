"""Curves as PNG files; the only module that uses matplotlib, which is imported on first use."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

from annotator.evaluation.report import Diagram
from annotator.files import write_atomic
from annotator.types.errors import FormatError

INCHES = (6.4, 4.8)
DPI = 120


def draw_curves(diagrams: Sequence[Diagram], folder: Path) -> list[Path]:
    """Writes one PNG per diagram into a folder, which is created if missing; existing files are replaced.

    Returns:
        the files, in the order of the diagrams.

    Raises:
        FormatError: the folder or a file cannot be written.
    """
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for diagram in diagrams:
            # class names may contain characters that are invalid in file names
            path = folder / (re.sub(r"[^\w.-]+", "_", diagram.name).lstrip(".") + ".png")
            if path in written:
                path = path.with_stem(f"{path.stem}-{len(written)}")
            write_atomic(path, _png(diagram))
            written.append(path)
    except OSError as error:
        raise FormatError(folder, f"the curves cannot be written ({error.strerror})") from error
    return written


def _png(diagram: Diagram) -> bytes:
    # not pyplot, which needs a display
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=INCHES, dpi=DPI, layout="constrained")
    axes = figure.add_subplot(xlim=(0.0, 1.0), ylim=(0.0, 1.02), xlabel="recall", ylabel=diagram.y_label)
    axes.set_title(diagram.title)
    axes.grid(alpha=0.3)
    for line in diagram.lines:
        axes.plot(line.recall, line.precision, label=line.name)
    if diagram.lines:
        axes.legend(loc="lower left", fontsize="small")
    content = io.BytesIO()
    FigureCanvasAgg(figure).print_png(content)
    return content.getvalue()
