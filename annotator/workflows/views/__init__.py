"""Pseudo-views as image files, and relations between the stored ones."""
