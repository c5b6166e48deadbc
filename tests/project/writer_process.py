"""A process that writes to a project on commands from its standard input, and acknowledges each write.

loop FRAME     append events to the frame until killed; print the id and revision of each acknowledged event
once FRAME R   one write to the frame, based on revision R: prints "won" or "stale"
"""

from __future__ import annotations

import sys
from pathlib import Path

from store_samples import by_hand, proposal_at

from annotator.project import Project, open_project
from annotator.types import BoxKind
from annotator.types.errors import StaleRevisionError


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _loop(project: Project, frame: int) -> None:
    revision = project.frames.get(frame).revision
    while True:
        proposals = [proposal_at(float(n), steps=2, views=4) for n in range(3)]
        receipt = project.proposals.replace(frame, proposals, by_hand(revision)).receipt
        _say(f"{receipt.event_ids[0]} {receipt.revision}")
        uid = project.labels.of_frame(frame)[-1].uid
        receipt = project.labels.delete(frame, uid, by_hand(receipt.revision))
        _say(f"{receipt.event_ids[0]} {receipt.revision}")
        revision = receipt.revision


def _once(project: Project, frame: int, revision: int) -> None:
    try:
        project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand(revision))
        _say("won")
    except StaleRevisionError:
        _say("stale")


def main() -> None:
    with open_project(Path(sys.argv[1])) as project:
        _say("ready")
        for line in sys.stdin:
            what, *numbers = line.split()
            {"loop": _loop, "once": _once}[what](project, *map(int, numbers))


if __name__ == "__main__":
    main()
