"""Datasets that annotator exported, opened as recordings again."""
