"""Evaluation of boxes against the ground truth."""
