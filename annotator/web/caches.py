"""Data that requests share: open frames, images of pseudo-views that are not stored in a project, loaded detectors."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from functools import partial
from pathlib import Path

from annotator.project import Project
from annotator.workflows.workbench.contact_sheet import SheetPictures
from annotator.workflows.workbench.drawing_steps import WholeBoxes
from annotator.workflows.workbench.frame_cache import FrameCache
from annotator.workflows.workbench.loaded_detectors import ReadyDetectors

# The image of a pseudo-view takes some 30 kB.
MOST_IMAGES = 1000


class ViewImageCache:
    """The latest PNG images of pseudo-views, by the SHA-256 of their content. Thread-safe."""

    def __init__(self, most: int = MOST_IMAGES) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._images: OrderedDict[str, bytes] = OrderedDict()

    def add(self, content: bytes) -> str:
        """Adds the content of a PNG file; returns its id, the same as that of `project.views.store`."""
        name = hashlib.sha256(content).hexdigest()
        with self._lock:
            self._images[name] = content
            self._images.move_to_end(name)
            while len(self._images) > self._most:
                self._images.popitem(last=False)
        return name

    def get(self, name: str) -> bytes | None:
        """The PNG, or None if it is not in the cache."""
        with self._lock:
            return self._images.get(name)


class Caches:
    """The caches of one application.

    Attributes:
        frames: recently opened frames.
        view_images: images of the pseudo-views shown by pages.
        sheets: pictures of contact sheets.
        detectors: loaded detectors of the projects.
    """

    def __init__(self) -> None:
        self.frames = FrameCache()
        self.view_images = ViewImageCache()
        self.sheets = SheetPictures(self.frames)
        self.detectors = ReadyDetectors()
        self._lock = threading.Lock()
        self._whole: dict[Path, WholeBoxes] = {}

    def whole_boxes(self, project: Project) -> WholeBoxes:
        """What offers whole boxes for the drawn objects of a project."""
        with self._lock:
            known = self._whole.get(project.path)
            if known is None or known.project is not project:  # opened again
                known = self._whole[project.path] = WholeBoxes(project, partial(self.frames.look, project))
            return known

    def close(self) -> None:
        """Stops the background threads of the caches."""
        self.frames.close()
        self.sheets.close()
        self.detectors.close()
