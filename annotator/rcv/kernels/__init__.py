"""Compiled loops of the recursion. Import these modules inside functions: they load numba."""
