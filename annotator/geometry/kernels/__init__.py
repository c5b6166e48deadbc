"""Compiled loops of the geometry. Import these modules on use: they load numba."""
