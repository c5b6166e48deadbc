"""Reads a COCO dataset with pycocotools: `read_coco.py ANNOTATIONS.json`."""

import contextlib
import io
import json
import sys
from importlib.metadata import version

from pycocotools.coco import COCO

with contextlib.redirect_stdout(io.StringIO()):
    coco = COCO(sys.argv[1])
names = {each["id"]: each["name"] for each in coco.loadCats(coco.getCatIds())}
pictures = {}
for image in coco.loadImgs(coco.getImgIds()):
    found = coco.loadAnns(coco.getAnnIds(imgIds=image["id"]))
    pictures[image["file_name"]] = {
        "size": [image["width"], image["height"]],
        "boxes": [[names[a["category_id"]], *a["bbox"], a["area"]] for a in found],
    }
json.dump({"software": f"pycocotools {version('pycocotools')}", "pictures": pictures}, sys.stdout)
