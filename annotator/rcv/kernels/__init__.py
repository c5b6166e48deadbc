"""Compiled loops of the recursion. Import these modules on use: they load numba."""
