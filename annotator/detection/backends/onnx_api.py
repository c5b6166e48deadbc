"""The only module that imports ONNX Runtime; switches off its telemetry first."""

from __future__ import annotations

import os
from typing import Any

from annotator.types.errors import MissingExtraError

# Read on import. If it is not set, the official builds send telemetry and store an id and a database in the user's
# home.
SWITCH = "ORT_DISABLE_TELEMETRY"


def onnxruntime() -> Any:
    """The module `onnxruntime`, loaded on the first call.

    Raises:
        MissingExtraError: it is not installed.
    """
    os.environ.setdefault(SWITCH, "1")
    try:
        import onnxruntime as module
    except ImportError as error:
        raise MissingExtraError("onnxruntime", "onnx") from error
    return module
