"""Generated recordings: a furnished room or a pair of hands, ray-cast, with exact truth."""

from annotator.recordings.generated.writer import write_generated

__all__ = ["write_generated"]
