"""Compiled loops of the geometry. Import these modules inside functions: they load numba."""
