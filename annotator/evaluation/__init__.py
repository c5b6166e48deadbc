"""Evaluation of boxes against true boxes."""
