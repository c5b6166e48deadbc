"""Reads a YOLO dataset with Ultralytics' check and one pass of its data loader, and KITTI's folder with torchvision.

`read_yolo_and_kitti.py YAML ROOT`, where ROOT/Kitti/raw is the folder. One program: both import torch for seconds.
"""

import contextlib
import io
import json
import os
import sys
from pathlib import Path

os.environ["YOLO_OFFLINE"] = "true"
os.environ["YOLO_VERBOSE"] = "false"

import torchvision
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
kitti = torchvision.datasets.Kitti(sys.argv[2])
frames = {}
for index in range(len(kitti)):
    image, objects = kitti[index]
    frames[Path(kitti.images[index]).stem] = {"size": image.size, "objects": objects}
software = f"ultralytics {ultralytics.__version__}, torchvision {torchvision.__version__}"
json.dump({"software": software, "pictures": pictures, "frames": frames}, sys.stdout)
