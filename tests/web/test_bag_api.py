"""The route that describes a bag whose topics must be chosen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bag_writer import BagWriter
from ros_takes import START_NS, write_camera, write_mount, write_scan

if TYPE_CHECKING:
    from live_server import Live


def test_a_bag_is_described(live: Live, tmp_path: Path) -> None:
    folder = live.settings.folders[0]
    with BagWriter(tmp_path, "ros1") as bag:
        write_mount(bag)
        write_scan(bag, START_NS)
        for name in ("left", "right"):
            write_camera(bag, name, START_NS)
    placed = folder / "described.bag"
    bag.path.rename(placed)
    path = f"{folder.name}/{placed.name}"
    try:
        answer = live.client.get("/api/bags", params={"path": path}).json()
        assert "--image: /left/image_raw (1 message), /right/image_raw" in answer["problem"]
        assert str(folder) not in answer["problem"]
        assert (answer["frames"], answer["picture"]) == (0, "")
        params = {"path": path, "image": "/left/image_raw", "camera_info": "/right/camera_info"}
        answer = live.client.get("/api/bags", params=params).json()
        assert (answer["frames"], answer["problem"]) == (1, "")
        assert answer["picture"].startswith("data:image/jpeg;base64,")
        assert {topic["name"]: topic["use"] for topic in answer["topics"]}["/right/camera_info"] == "camera"
        assert live.client.get("/api/bags", params={"path": f"{path}x"}).status_code == 404
    finally:
        placed.unlink()
