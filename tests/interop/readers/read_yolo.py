"""Reads a YOLO dataset with Ultralytics' check and one pass of its data loader: `read_yolo.py YAML`."""

import contextlib
import io
import json
import os
import sys
from pathlib import Path

os.environ["YOLO_OFFLINE"] = "true"
os.environ["YOLO_VERBOSE"] = "false"

import ultralytics
from torch.utils.data import DataLoader
from ultralytics.data.dataset import YOLODataset
from ultralytics.data.utils import check_det_dataset

pictures = {}
with contextlib.redirect_stdout(io.StringIO()):
    data = check_det_dataset(sys.argv[1], autodownload=False)
    for part in ("train", "val"):
        dataset = YOLODataset(img_path=data[part], data=data, imgsz=320, augment=False, rect=False, batch_size=2)
        seen = 0
        for batch in DataLoader(dataset, 2, collate_fn=YOLODataset.collate_fn):
            seen += len(batch["cls"])
        for file, label in zip(dataset.im_files, dataset.labels, strict=True):
            height, width = label["shape"]
            rows = zip(label["cls"][:, 0], label["bboxes"], strict=True)
            pictures[f"{part}/{Path(file).name}"] = {
                "size": [width, height],
                "boxes": [[data["names"][int(number)], *map(float, shares)] for number, shares in rows],
            }
        assert seen == sum(len(label["cls"]) for label in dataset.labels)
json.dump({"software": f"ultralytics {ultralytics.__version__}", "pictures": pictures}, sys.stdout)
