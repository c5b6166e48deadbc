"""Evaluates boxes against true boxes."""
