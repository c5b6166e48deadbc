"""Reads a file with VCD, which validates its schema, and with openlabel-checker: `read_openlabel.py FILE`."""

import json
import sys
from importlib.metadata import version

from openlabel_checker import check_file
from scipy.spatial.transform import Rotation
from vcd.core import OpenLABEL

scene = OpenLABEL()
scene.load_from_file(sys.argv[1], validation=True)
frames = {}
for number, frame in scene.data["openlabel"]["frames"].items():
    boxes = []
    for uid in frame.get("objects", {}):
        for cuboid in frame["objects"][uid]["object_data"]["cuboid"]:
            val = scene.get_object_data(uid, cuboid["name"], int(number))["val"]
            signs = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
            corners = Rotation.from_quat(val[3:7]).apply(
                [[s * e for s, e in zip(sign, val[7:], strict=True)] for sign in signs]
            )
            boxes.append(
                {"label": scene.get_object(uid)["type"], "corners": (corners + val[:3]).tolist(),
                 "frame": cuboid.get("coordinate_system")}
            )  # fmt: skip
    frames[number] = {"boxes": boxes}
issues = [issue.to_dict() for outcome in check_file(sys.argv[1]).outcomes for issue in outcome.issues]
software = f"VCD {version('vcd')}, openlabel-checker {version('openlabel-checker')}"
json.dump(
    {"software": software, "frames": frames, "issues": issues, "systems": scene.get_coordinate_systems()}, sys.stdout
)
