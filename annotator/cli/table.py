"""The table of commands. A new command is one file and one row.

Each command is a plain function that returns None or an exit code; tyro builds the command line from its signature and
docstring. A name of two words is a command of a group.
"""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """One row: "module:function", and the line that `annotator --help` shows."""

    target: str
    summary: str


COMMANDS: dict[str, Command] = {
    "new": Command("annotator.cli.new:run", "create a project"),
    "add": Command("annotator.cli.add:run", "add recordings to a project"),
    "inspect": Command("annotator.cli.inspect:run", "show what a recording contains"),
    "import": Command("annotator.cli.import_boxes:run", "import 2D or 3D boxes from files"),
    "simulate": Command("annotator.cli.simulate:run", "draw 2D boxes from ground truth with a simulated operator"),
    "views": Command("annotator.cli.views:run", "write pseudo-views as images, to be labelled in another tool"),
    "train": Command("annotator.cli.train:run", "train the two 2D detectors"),
    "annotate": Command("annotator.cli.annotate:run", "propose oriented 3D boxes"),
    "lift": Command("annotator.cli.lift:run", "propose oriented 3D boxes from 2D boxes, without training"),
    "track": Command("annotator.cli.track:run", "link the boxes of each object into tracks"),
    "follow": Command("annotator.cli.follow:run", "follow reviewed boxes through a recording"),
    "interpolate": Command("annotator.cli.interpolate:run", "fill the frames between a track's reviewed boxes"),
    "export": Command("annotator.cli.export:run", "write the labels as a dataset"),
    "evaluate": Command("annotator.cli.evaluate:run", "score boxes against ground truth, by a benchmark's protocol"),
    "stats": Command("annotator.cli.stats:run", "show a project's progress"),
    "serve": Command("annotator.cli.serve:run", "start the workbench, a web page to draw and review boxes"),
    "live": Command("annotator.cli.live:run", "detect on a camera or on a recording as it plays, and show the boxes"),
    "check": Command("annotator.cli.check:run", "find errors in a dataset, or suspicious labels in a project"),
    "up": Command("annotator.cli.up:run", "show or set which way is up in a recording"),
    "calibrate": Command("annotator.cli.calibrate:run", "show or correct where clouds lie relative to images"),
    "project move": Command("annotator.cli.project_move:run", "set the new path of a moved recording"),
    "project remove": Command("annotator.cli.project_remove:run", "remove a recording, or a whole project"),
    "project rename": Command("annotator.cli.project_rename:run", "rename a project"),
    "project backup": Command("annotator.cli.project_backup:run", "write a backup, also while a server runs"),
    "project restore": Command("annotator.cli.project_restore:run", "make a project of a backup"),
    "project verify": Command("annotator.cli.project_verify:run", "check whether a project is sound"),
    "project repair": Command("annotator.cli.project_repair:run", "repair a project, or save what is readable"),
    "project copy": Command(
        "annotator.cli.project_copy:run", "copy a project, or take in one that somebody else has sent"
    ),
    "classes list": Command("annotator.cli.classes:show", "list classes, numbers of their boxes, and attributes"),
    "classes add": Command("annotator.cli.classes:add", "add a class"),
    "classes rename": Command("annotator.cli.classes:rename", "rename a class; its boxes follow"),
    "classes merge": Command("annotator.cli.classes:merge", "give the boxes of classes to another class"),
    "classes remove": Command("annotator.cli.classes:remove", "remove a class"),
    "classes order": Command("annotator.cli.classes:order", "set the order of the classes"),
    "classes style": Command("annotator.cli.classes:style", "set the colour and the key of a class"),
    "classes attribute": Command("annotator.cli.classes:attribute", "add or change an attribute"),
    "classes rename-attribute": Command("annotator.cli.classes:rename_attribute", "rename an attribute or a choice"),
    "classes order-attributes": Command("annotator.cli.classes:order_attributes", "set the order of the attributes"),
    "classes remove-attribute": Command("annotator.cli.classes:remove_attribute", "remove an attribute"),
    "generate": Command("annotator.cli.generate:run", "generate a synthetic recording with ground truth"),
    "doctor": Command(
        "annotator.cli.doctor:run", "report packages, devices and detector backends, and run a self-test"
    ),
    "demo": Command("annotator.cli.demo:run", "run the whole loop on a generated recording"),
    "completion": Command("annotator.cli.completion:run", "print a shell's completion script"),
}

GROUPS: dict[str, str] = {
    "project": "manage a project as a whole",
    "classes": "show and change the classes and attributes of a project",
}
"""First words of the two-word commands, and their summaries in `annotator --help`."""
