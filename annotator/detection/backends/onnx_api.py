"""The one door to ONNX Runtime: what is switched off before it loads."""

from __future__ import annotations

import os
from typing import Any

from annotator.types.errors import MissingExtraError

# Read as it loads: its official builds report to a service on the network, and keep an id and a database in the user's
# home, unless this is set.
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
