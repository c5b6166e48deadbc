"""The workbench in a window of its own: pywebview's, which shows the same page."""

from __future__ import annotations

import os
import sys
import threading
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal

from annotator.types.errors import ConfigError, MissingExtraError

if TYPE_CHECKING:
    from annotator.web.serve import Running

SIZE = (1366, 768)
INSTEAD = "leave --window out, and open the link in a browser"


def has_display() -> bool:
    """True where something can be shown."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_window() -> None:
    """Refuses, before the server begins, what could not be shown.

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
    """Qt where it is installed; else pywebview tries what there is, and prints what it does not find."""
    return "qt" if sys.platform == "linux" and find_spec("PySide6") else None


def in_window(server: Running, address: str) -> None:
    """Serves until the window is closed. Toolkits want the process's main thread, so the server gets another.

    Raises:
        ConfigError: no toolkit can show a window.
    """
    import webview

    thread = threading.Thread(target=server.serve_until_stopped, name="server")
    thread.start()
    try:
        webview.settings["ALLOW_DOWNLOADS"] = True
        webview.create_window("annotator", address, width=SIZE[0], height=SIZE[1])
        # not private: the operator's name is still known the next time
        webview.start(private_mode=False, gui=_toolkit())
    except webview.WebViewException as error:
        raise ConfigError(f"no window can be shown: {error}; {INSTEAD}") from error
    finally:
        server.should_exit = True
        thread.join()
