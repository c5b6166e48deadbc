"""The workbench in a desktop window (pywebview), which shows the same page."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from importlib.util import find_spec
from typing import Literal

from annotator.types.errors import ConfigError, MissingExtraError

SIZE = (1366, 768)
INSTEAD = "leave --window out, and open the link in a browser"


def has_display() -> bool:
    """True if this computer has a display."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_window() -> None:
    """Checks that a window can be shown, before the server starts.

    Raises:
        MissingExtraError: pywebview is not installed.
        ConfigError: there is no display.
    """
    try:
        import webview  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("pywebview", "desktop") from error
    if not has_display():
        raise ConfigError(f"there is no display for a window; {INSTEAD}")


def _toolkit() -> Literal["qt"] | None:
    """Qt if PySide6 is installed; otherwise pywebview tries all toolkits and prints the missing ones."""
    return "qt" if sys.platform == "linux" and find_spec("PySide6") else None


def in_window(serve: Callable[[], None], stop: Callable[[], None], address: str) -> None:
    """Serves until the window is closed. Toolkits need the process's main thread, so the server gets another.

    Args:
        serve: runs the server, and returns when `stop` has been called.

    Raises:
        ConfigError: no toolkit can show a window.
    """
    import webview

    thread = threading.Thread(target=serve, name="server")
    thread.start()
    try:
        webview.settings["ALLOW_DOWNLOADS"] = True
        webview.create_window("annotator", address, width=SIZE[0], height=SIZE[1])
        # not in private mode, so that the cookie with the operator's name is kept
        webview.start(private_mode=False, gui=_toolkit())
    except webview.WebViewException as error:
        raise ConfigError(f"no window can be shown: {error}; {INSTEAD}") from error
    finally:
        stop()
        thread.join()
