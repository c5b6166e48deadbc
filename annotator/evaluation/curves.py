"""Curves as PNG files. The one place where matplotlib is used, and only when something is drawn."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

from annotator.evaluation.report import Picture
from annotator.files import write_atomic
from annotator.types.errors import FormatError

INCHES = (6.4, 4.8)
DPI = 120


def draw_curves(pictures: Sequence[Picture], folder: Path) -> list[Path]:
    """Writes one PNG a picture into the folder, which is made where it is missing; what has the same name is replaced.

    Returns:
        the files, in the order of the pictures.

    Raises:
        FormatError: the folder or a file cannot be written.
    """
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for picture in pictures:
            # a class may have any name
            path = folder / (re.sub(r"[^\w.-]+", "_", picture.name).lstrip(".") + ".png")
            if path in written:
                path = path.with_stem(f"{path.stem}-{len(written)}")
            write_atomic(path, _png(picture))
            written.append(path)
    except OSError as error:
        raise FormatError(folder, f"the curves cannot be written ({error.strerror})") from error
    return written


def _png(picture: Picture) -> bytes:
    # not pyplot, which would look for a display
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=INCHES, dpi=DPI, layout="constrained")
    axes = figure.add_subplot(xlim=(0.0, 1.0), ylim=(0.0, 1.02), xlabel="recall", ylabel=picture.y_label)
    axes.set_title(picture.title)
    axes.grid(alpha=0.3)
    for line in picture.lines:
        axes.plot(line.recall, line.precision, label=line.name)
    if picture.lines:
        axes.legend(loc="lower left", fontsize="small")
    content = io.BytesIO()
    FigureCanvasAgg(figure).print_png(content)
    return content.getvalue()
