"""MCAP files with Foxglove's messages, of any writer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_takes import WRITERS, picture_take, write_mcap
from ros_takes import IMAGE, START_NS, K, seen_points

from annotator.recordings import open_recording


@pytest.mark.parametrize("how", WRITERS)
@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_messages_of_any_writer(tmp_path: Path, encoding: str, how: dict[str, Any]):
    path = tmp_path / "a.mcap"
    write_mcap(path, encoding, [(START_NS, picture_take(encoding))], **how)
    recording = open_recording(path)
    assert recording.notes == ()
    frame = recording.frame(0)
    np.testing.assert_array_equal(frame.rgb, IMAGE)
    np.testing.assert_allclose(frame.cloud.xyz_m, seen_points(), atol=1e-6)
    assert frame.timestamp_ns == START_NS
    np.testing.assert_array_equal(frame.camera.matrix, K)
