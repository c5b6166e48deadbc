"""The one door to numba: loops over many points or equations, compiled on first use.

Modules whose functions pass through here are imported by their callers on use, since numba takes a while to load.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """A function as machine code that holds no lock of the interpreter while it runs.

    The code is kept beside the source, or in the user's cache where that folder cannot be written to; where neither
    can, every process compiles for itself. Arithmetic is done as it is written, so results do not depend on the
    processor; a division by zero gives infinity, as in numpy.

    Args:
        function: of arrays and plain numbers, in the part of Python that numba compiles. What it calls must be
            compiled, too.
    """
    import numba

    # Run-time checks of types would wrap it, and cannot be compiled; its callers are checked.
    plain = inspect.unwrap(function)
    try:
        code = numba.njit(plain, nogil=True, error_model="numpy", cache=True)
    except RuntimeError:  # numba finds no folder for its cache
        code = numba.njit(plain, nogil=True, error_model="numpy")
    return cast(Function, code)
