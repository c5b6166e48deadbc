"""The topics of a bag, for people who choose among them."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.recordings.recording import ReaderOptions
from annotator.recordings.ros.bag import open_bag
from annotator.recordings.ros.realsense import realsense_uses
from annotator.recordings.ros.roles import choose, options_of, uses
from annotator.types.errors import InputError


class TopicReport(BaseModel):
    """A topic of a bag.

    Attributes:
        name, type: `package/Name` for all encodings.
        messages: their number.
        rate_hz: messages per second; None for fewer than two.
        use: what it is used for; "" = not used, or not chosen yet.
        option: that can name it, such as "--points"; "" = none.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    type: str
    messages: int
    rate_hz: float | None
    use: str
    option: str


def list_topics(path: Path, options: ReaderOptions) -> tuple[TopicReport, ...] | None:
    """Returns the topics of the bag at `path`, by name; None if it is not a bag.

    Raises:
        RecordingError: a file of the bag cannot be used.
        OSError: a file cannot be read.
    """
    bag = open_bag(path)
    if bag is None:
        return None
    try:
        chosen = choose(bag, options)
    except InputError:  # whoever opens the recording gets this error
        chosen = None
    used, options_by_name = realsense_uses(bag, chosen) | uses(bag, chosen), options_of(bag)
    return tuple(
        TopicReport(
            name=name, type=topic.type, messages=len(topic), rate_hz=topic.rate_hz,
            use=used.get(name, ""), option=options_by_name.get(name, ""),
        )
        for name, topic in sorted(bag.topics.items())
    )  # fmt: skip
