"""What the annotation routes keep between requests: open frames, and pictures that are in no project yet."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict

import numpy as np
from jaxtyping import UInt8

from annotator.project.views import png
from annotator.web.frame_cache import FrameCache
from annotator.workflows.detectors_ready import ReadyDetectors

# A picture of a pseudo-view takes some 30 kB.
PICTURES_KEPT = 1000


class PictureCache:
    """PNG pictures by their content's SHA-256, the last ones that were drawn. Threads share it."""

    def __init__(self, kept: int = PICTURES_KEPT) -> None:
        self._kept = kept
        self._lock = threading.Lock()
        self._pictures: OrderedDict[str, bytes] = OrderedDict()

    def add(self, rgb: UInt8[np.ndarray, "h w 3"]) -> str:
        """Keeps a picture for a while; its id, the same that `project.views.store` gives it."""
        content = png(rgb)
        name = hashlib.sha256(content).hexdigest()
        with self._lock:
            self._pictures[name] = content
            self._pictures.move_to_end(name)
            while len(self._pictures) > self._kept:
                self._pictures.popitem(last=False)
        return name

    def get(self, name: str) -> bytes | None:
        """The PNG, where it is still kept."""
        with self._lock:
            return self._pictures.get(name)


class Annotation:
    """One for each application.

    Attributes:
        frames: the frames that are looked at.
        pictures: of pseudo-views on the screen.
        detectors: of the projects, once they are loaded.
    """

    def __init__(self) -> None:
        self.frames = FrameCache()
        self.pictures = PictureCache()
        self.detectors = ReadyDetectors()

    def close(self) -> None:
        """Ends what runs in the background."""
        self.frames.close()
        self.detectors.close()
