"""Transforms between the coordinate systems of a document, at one frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from scipy.spatial.transform import RigidTransform

from annotator.formats.openlabel.model import CoordinateSystem, Transform, TransformData
from annotator.formats.openlabel.shapes import transform_from


class Coordinates:
    """The tree of a document's coordinate systems, with the transforms of one frame.

    Source: ASAM OpenLABEL 1.0.0: `pose_wrt_parent` and `transform_src_to_dst` are matrices that multiply column
    vectors of the child (the source) from the left. A frame's transform replaces the pose between the two systems.
    """

    def __init__(
        self, systems: Mapping[str, CoordinateSystem], of_frame: Mapping[str, Transform] | None = None
    ) -> None:
        """Raises ValueError for an invalid transform; names the coordinate system."""
        self._edges: dict[str, dict[str, RigidTransform]] = {name: {} for name in systems}
        for name, system in systems.items():
            if system.pose_wrt_parent is not None and system.parent:
                self._connect(f"pose_wrt_parent of {name}", system.parent, name, system.pose_wrt_parent)
        for name, each in (of_frame or {}).items():
            self._connect(f"transform {name}", each.dst, each.src, each.transform_src_to_dst)

    def __contains__(self, name: str) -> bool:
        return name in self._edges

    def transform(self, dst: str, src: str) -> RigidTransform:
        """Returns T_dst_src.

        Raises:
            ValueError: the two systems are not connected.
        """
        from_src = {src: RigidTransform.identity()}
        waiting = deque([src])
        while waiting and dst not in from_src:
            here = waiting.popleft()
            for there, T_there_here in self._edges.get(here, {}).items():
                if there not in from_src:
                    from_src[there] = T_there_here * from_src[here]
                    waiting.append(there)
        if dst not in from_src:
            raise ValueError(
                f"the coordinate systems {src!r} and {dst!r} are not connected; give each a parent and "
                "pose_wrt_parent, or add a transform to the frame"
            )
        return from_src[dst]

    def _connect(self, where: str, dst: str, src: str, data: TransformData) -> None:
        try:
            T_dst_src = transform_from(data)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        self._edges.setdefault(src, {})[dst] = T_dst_src
        self._edges.setdefault(dst, {})[src] = T_dst_src.inv()
