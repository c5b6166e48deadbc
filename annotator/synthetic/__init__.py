"""Generated recordings: people in a furnished room, or hands, rendered by ray casting, with exact ground truth."""

from annotator.synthetic.writer import write_generated
