"""The only module that uses numba: it compiles loops over many points or equations on first use.

Modules with compiled functions are imported inside the functions that use them, because numba takes long to load.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable
from functools import cache
from typing import TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compiles a function to machine code that runs without the GIL.

    The code is cached beside the source, or in the user's cache folder if that is not writable. If neither is writable,
    every process compiles again. Floating-point operations are not reordered, so results do not depend on the
    processor. A division by zero gives infinity, as in numpy.

    Args:
        function: takes arrays and plain numbers, and uses the part of Python that numba supports. The functions that it
            calls must be compiled, too.
    """
    import numba

    # numba cannot compile the wrappers of run-time type checks
    plain = inspect.unwrap(function)
    try:
        code = numba.njit(plain, nogil=True, error_model="numpy", cache=True)
    except RuntimeError:  # numba finds no folder for its cache
        _warn()
        code = numba.njit(plain, nogil=True, error_model="numpy")
    return cast(Function, code)


@cache
def _warn() -> None:
    logging.getLogger("annotator.compiled").warning(
        "every process compiles for half a minute: no folder for machine code can be written to; set NUMBA_CACHE_DIR"
    )
