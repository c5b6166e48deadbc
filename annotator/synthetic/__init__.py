"""Generated recordings: people in a furnished room, or hands, rendered by ray casting, with exact truth."""

from annotator.synthetic.writer import write_generated

__all__ = ["write_generated"]
