"""A scene in viser, updated by sending only the differences."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.ground import Ground, find_ground
from annotator.rcv.pseudo_view import BACKGROUND
from annotator.types import Frame, OrientedBox, PointCloud
from annotator.web.viewport.drawing import (
    CAMERA_UP,
    Draft,
    Gizmo,
    SceneContent,
    box_lines,
    frustum_lines,
    placed_box_lines,
    point_colors,
    point_size_m,
    scene_up,
    shown_points,
    view_placement,
    wanted_points,
)
from annotator.web.viewport.faces import FaceHandles
from annotator.web.viewport.guides import Look, Stand, arrow_lines, guide_lines, scene_reach_m, stand
from annotator.web.viewport.palette import Color, Palette
from annotator.web.viewport.viser_page import configure_theme

if TYPE_CHECKING:
    import viser

    from annotator.web.viewport.faces import OnFace

    OnGizmo = Callable[[viser.TransformControlsEvent], Coroutine[None, None, None]]

AXIS_COLOR = (255, 59, 48)
HAIR_PX, THIN_PX, THICK_PX = 1.0, 1.6, 4.0
# Opacity of a pseudo-view's empty pixels, 0..255.
EMPTY_ALPHA = 90
# Farther than any viewer sees, metres.
FAR_M = 1e9
# Size of the gizmo, as a share of the selected box's longest side, and its minimum, metres.
GIZMO_SHARE, GIZMO_LEAST_M = 0.75, 0.08

# The cloud that is shown, and a hidden one that may be shown next.
CLOUDS = ("/cloud", "/cloud2")
SHADER, GUIDES, BOXES = "/shader", "/guides", "/boxes"
SELECTED, SELECTED_LINES = "/selected", "/selected/lines"
FRUSTUM, DRAFT_BOX, AXES = "/draft/frustum", "/draft/box", "/draft/axes"
NO_POINTS = PointCloud(np.zeros((0, 3), np.float32))


@dataclass(eq=False)
class ShownCloud:
    """The points of a frame in the browser: those of `key`, coloured for `colors_key`; no frame = none.

    Attributes:
        size_m: the default size of a point.
    """

    name: str
    frame: Frame | None = None
    key: tuple[object, ...] = ()
    colors_key: tuple[object, ...] = ()
    points: PointCloud = NO_POINTS
    size_m: float = 0.0

    def has(self, frame: Frame, content: SceneContent) -> bool:
        """Whether these are the points of a frame that the content asks for."""
        return self.frame is frame and self.key == content.points_key


class Scene:
    """The scene of one viser server. Not thread-safe."""

    def __init__(self, server: viser.ViserServer, on_gizmo: OnGizmo, on_face: OnFace) -> None:
        self._server = server
        self._api = server.scene
        self._on_gizmo = on_gizmo
        self._faces = FaceHandles(server.scene, on_face)
        self._shown, self._other = (ShownCloud(name) for name in CLOUDS)
        self._ground, self._reach_m = find_ground(NO_POINTS.xyz_m, CAMERA_UP), 0.0
        self.content = SceneContent(None, None)
        self._api.configure_default_lights(False)
        self._api.configure_environment_map(None)
        self._api.world_axes.visible = False
        self._gizmo: viser.TransformControlsHandle | None = None
        # A cloud that is never seen. With each new cloud, the browser makes its shader anew unless another one uses it.
        self._add_points(SHADER, np.full((2, 3), FAR_M, np.float32), np.zeros((2, 3), np.uint8), 0.0)

    @property
    def gizmo(self) -> viser.TransformControlsHandle:
        """The gizmo, created on first use; the selected box is its child, so that it follows without delay."""
        if self._gizmo is None:
            self._gizmo = self._api.add_transform_controls(
                SELECTED, line_width=3.0, depth_test=False, opacity=0.9, visible=False
            )
            self._gizmo.on_update(self._on_gizmo)
        return self._gizmo

    def show(self, content: SceneContent, hold_gizmo: bool = False) -> tuple[int, int]:
        """Updates the scene in one atomic message; returns the number of shown points, and of all.

        Args:
            hold_gizmo: keep the selected box, its gizmo and its handles as they are, during a drag.
        """
        before, self.content = self.content, content
        is_new_theme = content.theme is not before.theme
        with self._server.atomic():
            if is_new_theme:
                configure_theme(self._server, content.theme)
            if content.frame is not before.frame and content.frame is not None:
                self._ground = content.ground or find_ground(content.frame.cloud.xyz_m, scene_up(content.frame))
                if content.key != before.key:
                    self._reach_m = scene_reach_m(content.frame)
            if content.frame is not None and (content.frame is not before.frame or is_new_theme):
                lines, colors = guide_lines(content.frame, self._ground, self._reach_m, content.palette)
                self._lines(GUIDES, lines, _light(colors), HAIR_PX)
            if content.frame is None:
                self._remove(GUIDES)
            look = Look.START if content.key != before.key else content.look
            if content.frame is not None and look is not None:
                self._look(look, content.frame)
            counts = self._show_cloud()
            self._show_boxes()
            self._show_selected(hold_gizmo)
            if content.draft is not before.draft or content.frame is not before.frame or is_new_theme:
                self._show_draft(content.draft, content.frame)
            self._send_ahead()
        self._server.flush()
        return counts

    # --- the cloud -------------------------------------------------------------------------------------------------

    def _show_cloud(self) -> tuple[int, int]:
        content, frame = self.content, self.content.frame
        if frame is None:
            for cloud in (self._shown, self._other):
                self._empty(cloud)
            return 0, 0
        if self._other.has(frame, content) and not self._shown.has(frame, content):
            self._shown, self._other = self._other, self._shown
        if self._shown.has(frame, content):
            self._color(self._shown, self._ground)
        else:
            self._send(self._shown, frame, self._ground)
        for cloud in (self._shown, self._other):
            handle = self._api.get_handle_by_name(cloud.name)
            if handle is not None:
                handle.visible = cloud is self._shown
        return len(self._shown.points), len(frame.cloud)

    def _send_ahead(self) -> None:
        """Sends the hidden points of the frame that may be shown next: then the browser only has to draw them."""
        ahead, content = self.content.ahead, self.content
        # what depends on the boxes is not known yet
        if (
            ahead is None
            or ahead.frame is content.frame
            or content.is_of_boxes
            or self._other.has(ahead.frame, content)
        ):
            return
        self._send(self._other, ahead.frame, ahead.ground, visible=False)

    def _send(self, cloud: ShownCloud, frame: Frame, ground: Ground, visible: bool = True) -> None:
        """Sends points as one message, since the browser creates new buffers for them anyway."""
        content = self.content
        wanted = wanted_points(content, frame, ground)
        cloud.points = shown_points(wanted, content.most_points)
        cloud.frame, cloud.key, cloud.colors_key = frame, content.points_key, content.colors_key
        if len(cloud.points) == 0:
            self._remove(cloud.name)
            return
        cloud.size_m = point_size_m(frame, len(cloud.points) / max(len(wanted), 1))
        colors = self._point_colors(cloud, ground)
        self._add_points(cloud.name, cloud.points.xyz_m, colors, cloud.size_m * content.point_size, visible)

    def _color(self, cloud: ShownCloud, ground: Ground) -> None:
        """Gives points their present colours and size."""
        content = self.content
        handle: Any = self._api.get_handle_by_name(cloud.name)
        if handle is None:
            return
        if cloud.colors_key != content.colors_key:
            cloud.colors_key = content.colors_key
            handle.colors = self._point_colors(cloud, ground)
        handle.point_size = cloud.size_m * content.point_size

    def _empty(self, cloud: ShownCloud) -> None:
        cloud.frame, cloud.points = None, NO_POINTS
        self._remove(cloud.name)

    def _point_colors(self, cloud: ShownCloud, ground: Ground) -> UInt8[np.ndarray, "n 3"]:
        content = self.content
        return point_colors(cloud.points, content.color, ground, content.palette, content.boxes)

    def _add_points(
        self, name: str, xyz_m: np.ndarray, colors: UInt8[np.ndarray, "n 3"], size_m: float, visible: bool = True
    ) -> None:
        self._api.add_point_cloud(
            name,
            xyz_m,
            colors,
            point_size=size_m,
            point_shape="square",
            point_shading="flat",
            precision="float32",
            visible=visible,
        )

    # --- boxes -----------------------------------------------------------------------------------------------------

    def _show_boxes(self) -> None:
        """Draws all boxes except the selected one as one set of lines."""
        selected = self.content.selected_box
        is_alone = self.content.only_selected and selected is not None
        rest = [] if is_alone else [shown for shown in self.content.boxes if shown is not selected]
        if not rest:
            self._remove(BOXES)
            return
        lines = [placed_box_lines(shown.box) for shown in rest]
        colors = [
            np.broadcast_to(_light(shown.color or self.content.palette.states[shown.state]), part.shape)
            for shown, part in zip(rest, lines, strict=True)
        ]
        self._lines(BOXES, np.concatenate(lines), np.concatenate(colors), THIN_PX)

    def _show_selected(self, hold_gizmo: bool) -> None:
        selected, mode = self.content.selected_box, self.content.gizmo
        if selected is None:
            if self._gizmo is not None:
                self.gizmo.visible = False
            return
        gizmo = self.gizmo
        gizmo.disable_axes = gizmo.disable_sliders = mode is not Gizmo.TRANSLATE
        gizmo.disable_rotations = mode is not Gizmo.ROTATE
        if not hold_gizmo:
            self.place_selected(selected.box)
        gizmo.visible = True

    def place_selected(self, box: OrientedBox) -> None:
        """Draws the selected box, with its gizmo and handles, as this one."""
        selected, gizmo = self.content.selected_box, self.gizmo
        assert selected is not None
        color = _light(_selected(selected.color or self.content.palette.states[selected.state], self.content.palette))
        lines = box_lines(box.size_m)
        # a colour for each end, as all lines have, so that they share a shader
        self._lines(SELECTED_LINES, lines, np.broadcast_to(color, lines.shape), THICK_PX)
        gizmo.scale = max(GIZMO_SHARE * float(box.size_m.max()), GIZMO_LEAST_M)
        gizmo.position = box.center_m
        gizmo.wxyz = box.T_camera_box.rotation.as_quat(scalar_first=True)
        self._faces.show(box.size_m if self.content.gizmo is Gizmo.FACES else None)

    def gizmo_box(self) -> OrientedBox | None:
        """The selected box at the pose of the gizmo; None without a selection."""
        selected = self.content.selected_box
        if selected is None or self._gizmo is None:
            return None
        rotation = Rotation.from_quat(np.asarray(self._gizmo.wxyz, np.float64), scalar_first=True)
        pose = RigidTransform.from_components(np.asarray(self._gizmo.position, np.float64), rotation)
        return OrientedBox.at(pose, selected.box.size_m)

    # --- an object that is being labelled --------------------------------------------------------------------------

    def _show_draft(self, draft: Draft | None, frame: Frame | None) -> None:
        if draft is None or frame is None:
            self._remove("/draft")
            return
        self._lines(FRUSTUM, frustum_lines(frame, draft.image_box), _light(self.content.palette.frustum), THIN_PX)
        if draft.box is None:
            self._remove(DRAFT_BOX)
        else:
            self._lines(DRAFT_BOX, placed_box_lines(draft.box), _light(self.content.palette.draft), THICK_PX)
        self._show_views(draft)

    def _show_views(self, draft: Draft) -> None:
        placements = [view_placement(view) for view in draft.views]
        for number in range(len(placements), 2):
            self._remove(f"/draft/view{number}")
        for number, (view, placement) in enumerate(zip(draft.views, placements, strict=True)):
            self._api.add_image(
                f"/draft/view{number}",
                _with_alpha(view.rgb),
                *view.extent_m.tolist(),
                format="png",
                wxyz=Rotation.from_matrix(view.axes.T).as_quat(scalar_first=True),
                position=placement[1],
            )
        if not placements:
            self._remove(AXES)
            return
        # the head is at the view's image, in front of all points
        arrows = np.concatenate([arrow_lines(*placement) for placement in placements])
        self._lines(AXES, arrows, _light(AXIS_COLOR), THICK_PX)

    # --- helpers ---------------------------------------------------------------------------------------------------

    def _lines(self, name: str, points: np.ndarray, colors: UInt8[np.ndarray, "*k 3"], thickness: float) -> None:
        """Draws lines under a name; unchanged lines send nothing."""
        import viser

        handle = self._api.get_handle_by_name(name)
        if isinstance(handle, viser.LineSegmentsHandle) and handle.points.shape == points.shape:
            handle.points = points
            handle.colors = colors
            return
        self._api.add_line_segments(name, points, colors, thickness=thickness, thickness_units="screen")

    def _remove(self, name: str) -> None:
        handle = self._api.get_handle_by_name(name)
        if handle is not None:
            handle.remove()

    def _look(self, look: Look, frame: Frame) -> None:
        """Moves the viewers, and where new ones begin."""
        selected = self.content.selected_box
        box, ahead = None if selected is None else selected.box, np.array([0.0, 0.0, 1.0])
        first = stand(look, frame, self._ground, box, ahead, 1.5)
        if first is None:
            return
        if look is Look.START:
            self._api.set_up_direction(first.up)
            _move(self._server.initial_camera, "up", first)
        for client in self._server.get_clients().values():
            camera = client.camera
            gaze = np.asarray(camera.look_at) - camera.position
            gaze = gaze / max(float(np.linalg.norm(gaze)), 1e-6)
            with client.atomic():
                _move(camera, "up_direction", stand(look, frame, self._ground, box, gaze, camera.aspect) or first)


def _move(camera: viser.CameraHandle | viser.InitialCameraConfig, up: str, to: Stand) -> None:
    """Moves a viewer; `up` is the name of that attribute, which the two classes call differently."""
    setattr(camera, up, to.up)
    camera.fov, camera.position, camera.look_at = to.fov_rad, to.position_m, to.look_at_m


def _selected(color: Color, palette: Palette) -> Color:
    level, share = palette.selected
    red, green, blue = (round(old + share * (level - old)) for old in color)
    return red, green, blue


def _light(color: Color | UInt8[np.ndarray, "*k 3"]) -> UInt8[np.ndarray, "*k 3"]:
    """An sRGB colour as linear light, which the browser's line shader expects."""
    return np.round(255 * (np.array(color) / 255) ** 2.2).astype(np.uint8)


def _with_alpha(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 4"]:
    """A view's image with translucent empty pixels, so that the points and the arrow behind it are visible."""
    alpha = np.where((rgb == BACKGROUND).all(axis=2), EMPTY_ALPHA, 255).astype(np.uint8)
    return np.dstack([rgb, alpha])
