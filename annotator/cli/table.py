"""The commands: name -> where its function is, and what it does in one line. A new command is one file and one row.

A command's function is a plain function: tyro makes the command line from its signature and docstring. It returns
None or an exit code.
"""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """One row: "module:function", and the line that `annotator --help` shows."""

    target: str
    summary: str


COMMANDS: dict[str, Command] = {
    "new": Command("annotator.cli.new:run", "create a project"),
    "add": Command("annotator.cli.add:run", "put recordings into a project"),
    "move": Command("annotator.cli.move:run", "say where a recording is now whose folder was moved"),
    "inspect": Command("annotator.cli.inspect:run", "say what a recording holds"),
    "import": Command("annotator.cli.import_boxes:run", "take over 2D boxes drawn elsewhere"),
    "simulate": Command("annotator.cli.simulate:run", "let a simulated operator draw 2D boxes from known truth"),
    "views": Command("annotator.cli.views:run", "write pseudo-views as pictures, to be labelled elsewhere"),
    "train": Command("annotator.cli.train:run", "train the two 2D detectors"),
    "annotate": Command("annotator.cli.annotate:run", "propose oriented 3D boxes"),
    "track": Command("annotator.cli.track:run", "link the boxes of each object over a recording"),
    "interpolate": Command("annotator.cli.interpolate:run", "fill the frames between a track's reviewed boxes"),
    "export": Command("annotator.cli.export:run", "write a dataset"),
    "evaluate": Command("annotator.cli.evaluate:run", "measure boxes against truth, by the rules of a benchmark"),
    "stats": Command("annotator.cli.stats:run", "say how far a project is"),
    "serve": Command("annotator.cli.serve:run", "open the workbench in the browser"),
    "live": Command(
        "annotator.cli.live:run", "show boxes on what a camera sees now, or on a recording as it is played"
    ),
    "check": Command("annotator.cli.check:run", "find what is wrong with a dataset, or with a project's labels"),
    "generate": Command("annotator.cli.generate:run", "make a recording of a generated room, with its truth"),
    "demo": Command("annotator.cli.demo:run", "run the whole loop on a generated recording"),
}
