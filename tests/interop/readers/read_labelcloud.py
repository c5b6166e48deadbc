"""Reads folders with labelCloud's own readers, each as the working folder: `read_labelcloud.py FOLDER ...`.
PyQt5 is not installed and is replaced by mocks; only labelCloud's window needs it.
"""

import json
import os
import sys
from importlib.metadata import version
from pathlib import Path
from unittest.mock import MagicMock


def main() -> None:
    for name in ("PyQt5", "PyQt5.QtCore", "PyQt5.QtGui", "PyQt5.QtWidgets", "PyQt5.QtOpenGL", "PyQt5.uic"):
        sys.modules[name] = MagicMock()
    from labelCloud.io.labels.centroid import CentroidFormat
    from labelCloud.io.labels.config import LabelConfig
    from labelCloud.io.labels.vertices import VerticesFormat
    from labelCloud.io.pointclouds.open3d import Open3DHandler

    def read() -> dict[str, object]:
        config = LabelConfig()
        config.load_config()
        readers = {"centroid_rel": (CentroidFormat, True), "vertices": (VerticesFormat, False)}
        kind, relative = readers[str(config.format)]
        reader = kind(Path("labels"), 8, relative)
        frames = {}
        for path in sorted(Path("pointclouds").glob("*.ply")):
            points, colors = Open3DHandler().read_point_cloud(path)
            boxes = reader.import_labels(path)
            frames[path.stem] = {
                "boxes": [{"label": box.get_classname(), "corners": box.get_vertices().tolist()} for box in boxes],
                "points": len(points),
                "colored": colors is not None and len(colors) == len(points),
                "first_m": points[0].tolist(),
            }
        return {"frames": frames, "classes": [each.name for each in config.classes], "format": str(config.format)}

    seen = []
    for folder in sys.argv[1:]:
        os.chdir(folder)
        seen.append(read())
    json.dump({"software": f"labelCloud {version('labelCloud')}", "folders": seen}, sys.stdout)


main()
