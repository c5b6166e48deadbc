"""Loads what the first page needs while the browser is still opening it."""

from __future__ import annotations

import logging
import threading
from importlib import import_module

from annotator.workflows.warm_up import BOX, warm_frame
from annotator.workflows.workbench.contact_sheet import picture

LOG = logging.getLogger("annotator.web")


def preload() -> threading.Thread:
    """Starts a thread that loads the library of the 3D view and the compiled functions that draw a frame."""
    thread = threading.Thread(target=_load, name="preload", daemon=True)
    thread.start()
    return thread


def _load() -> None:
    try:
        # counts points and draws views, as every page does
        picture(warm_frame(), BOX)
        import_module("viser")
    except Exception:  # the page shows it when it needs this
        LOG.exception("loading ahead failed")
