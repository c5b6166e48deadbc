"""Converts annotator's types to and from the records of an `rcv` dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.rcv.model import (
    FRAME_OF_REFERENCE,
    Matrix3,
    RcvCamera,
    RcvLabels,
    RcvObject,
    RcvPose,
    RcvSaid,
    Vector3,
)
from annotator.geometry.transforms import corners_4x8
from annotator.types import Camera, Frame, Label, OrientedBox
from annotator.types.label import AttributeValue, Said

# Tolerance between quaternion or corners and the centre, rotation and size; metres for corners.
AGREEMENT = 1e-6


def camera_record(camera: Camera) -> RcvCamera:
    return RcvCamera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=camera.distortion,
    )


def camera_from(record: RcvCamera) -> Camera:
    """Returns the camera; raises ValueError for a number of distortion coefficients that OpenCV does not support."""
    size = (record.width_px, record.height_px)
    return Camera(*size, record.fx, record.fy, record.cx, record.cy, record.distortion)


def labels_record(
    frame_id: str,
    recording: str,
    frame: Frame,
    labels: Sequence[Label],
    image: str,
    cloud: str,
    attributes: Mapping[str, AttributeValue],
) -> RcvLabels:
    """Returns the record of one frame; `image` and `cloud` are its files within the dataset."""
    return RcvLabels(
        id=frame_id,
        recording=recording,
        key=frame.key,
        index=frame.index,
        timestamp_ns=frame.timestamp_ns,
        image=image,
        cloud=cloud,
        points=len(frame.cloud),
        frame_of_reference=FRAME_OF_REFERENCE,
        up=None if frame.up is None else _vector(frame.up),
        camera=camera_record(frame.camera),
        world=None if frame.T_world_camera is None else _pose(frame.T_world_camera),
        attributes=dict(attributes),
        objects=tuple(object_record(label) for label in labels),
    )


def object_record(label: Label) -> RcvObject:
    box = label.box
    return RcvObject(
        uid=label.uid,
        label=label.label,
        score=label.score,
        source=label.source,
        state=label.state,
        author=label.author,
        time_ns=label.time_ns,
        track_id=label.track_id,
        expected_iou_loss=label.expected_iou_loss,
        suggestion=label.suggestion,
        box_kind=label.box_kind,
        attributes=dict(label.attributes),
        said=tuple(map(_said_record, label.said)),
        center=_vector(box.center_m),
        size=_vector(box.size_m),
        rotation=_matrix(box.rotation),
        quaternion=_quaternion(box.T_camera_box),
        corners=tuple(tuple(row) for row in corners_4x8(box).tolist()),
    )


def label_from(record: RcvObject) -> Label:
    """Returns the label of a record.

    Raises:
        ValueError: the rotation is invalid, or quaternion or corners disagree with centre, size and rotation.
    """
    rotation = np.array(record.rotation)
    box = OrientedBox.from_parts(np.array(record.center), rotation, np.array(record.size))
    quaternion = Rotation.from_quat(record.quaternion, scalar_first=True)
    if np.abs(quaternion.as_matrix() - box.rotation).max() > AGREEMENT:
        raise ValueError("quaternion and rotation disagree; correct the quaternion from the rotation")
    # the quaternion gives an exactly orthonormal rotation, the matrix only a rounded one
    box = OrientedBox.at(RigidTransform.from_components(np.array(record.center), quaternion), np.array(record.size))
    reach = 1.0 + np.abs(box.center_m).max() + box.size_m.max()
    if np.abs(corners_4x8(box) - np.array(record.corners)).max() > AGREEMENT * reach:
        raise ValueError("corners disagree with center, size and rotation; correct the corners")
    return Label(
        uid=record.uid,
        label=record.label,
        box=box,
        score=record.score,
        source=record.source,
        state=record.state,
        author=record.author,
        time_ns=record.time_ns,
        track_id=record.track_id,
        expected_iou_loss=record.expected_iou_loss,
        suggestion=record.suggestion,
        box_kind=record.box_kind,
        attributes=record.attributes,
        said=tuple(map(_said, record.said)),
    )


def _said_record(said: Said) -> RcvSaid:
    return RcvSaid(
        source=said.source,
        label=said.label,
        score=said.score,
        track_id=said.track_id,
        box_kind=said.box_kind,
        center=_vector(said.box.center_m),
        size=_vector(said.box.size_m),
        quaternion=_quaternion(said.box.T_camera_box),
    )


def _said(record: RcvSaid) -> Said:
    rotation = Rotation.from_quat(record.quaternion, scalar_first=True)
    box = OrientedBox.at(RigidTransform.from_components(np.array(record.center), rotation), np.array(record.size))
    return Said(record.source, record.label, box, record.score, record.track_id, record.box_kind)


def _pose(T: RigidTransform) -> RcvPose:
    return RcvPose(translation=_vector(T.translation), quaternion=_quaternion(T))


def pose_from(record: RcvPose) -> RigidTransform:
    """Returns the transform of a record; raises ValueError for a quaternion of length zero."""
    rotation = Rotation.from_quat(record.quaternion, scalar_first=True)
    return RigidTransform.from_components(np.array(record.translation), rotation)


def _quaternion(T: RigidTransform) -> tuple[float, float, float, float]:
    w, x, y, z = T.rotation.as_quat(canonical=True, scalar_first=True).tolist()
    return (w, x, y, z)


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = values.tolist()
    return (x, y, z)


def _matrix(values: np.ndarray) -> Matrix3:
    return (_vector(values[0]), _vector(values[1]), _vector(values[2]))
