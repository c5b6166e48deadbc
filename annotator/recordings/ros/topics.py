"""The topics of a bag, for people who choose among them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotator.recordings.options import ReaderOptions
from annotator.recordings.ros.files import open_bag
from annotator.recordings.ros.roles import choose, options_of, uses
from annotator.types.errors import InputError


@dataclass(frozen=True)
class TopicFacts:
    """A topic of a bag.

    Attributes:
        name, type: `package/Name` for all encodings.
        messages: their number.
        rate_hz: messages per second; None for fewer than two.
        use: what it is used for; "" = not used.
        option: that can name it, such as "--points"; "" = none.
    """

    name: str
    type: str
    messages: int
    rate_hz: float | None
    use: str
    option: str


def list_topics(path: Path, options: ReaderOptions) -> list[TopicFacts] | None:
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
    used, options_by_name = uses(bag, chosen), options_of(bag)
    return [
        TopicFacts(name, topic.type, len(topic), topic.rate_hz, used.get(name, ""), options_by_name.get(name, ""))
        for name, topic in sorted(bag.topics.items())
    ]
