"""labelCloud: a folder of coloured clouds with a JSON file of fully oriented boxes each.

model.py        the JSON files
boxes.py        boxes as centre, sizes and angles, or as corners
calibration.py  from a cloud's frame to the camera
write.py        a folder that labelCloud opens; read.py: one that it, or write.py, has written
"""

from annotator.formats.labelcloud.read import LabelCloudFrame, read_labelcloud
from annotator.formats.labelcloud.write import write_labelcloud

__all__ = ["LabelCloudFrame", "read_labelcloud", "write_labelcloud"]
