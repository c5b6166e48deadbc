"""The live page: one viser view of what the pipeline sees now."""
