"""labelCloud: a folder of coloured clouds, each with a JSON file of fully oriented boxes.

model.py        the JSON files
boxes.py        boxes as centre, sizes and angles, or as corners
calibration.py  transform from a cloud's frame to the camera
write.py        writes a folder that labelCloud opens
read.py         reads a folder of labelCloud or of write.py
"""

from annotator.formats.labelcloud.read import LabelCloudFrame, read_labelcloud
from annotator.formats.labelcloud.write import write_labelcloud

__all__ = ["LabelCloudFrame", "read_labelcloud", "write_labelcloud"]
