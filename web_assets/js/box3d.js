// Oriented boxes and their orthogonal views: pure functions that return a new box and never change the old one.

import {
  aboutAxis,
  add,
  angleBetween,
  column,
  dot,
  fromAngles,
  fromColumns,
  length,
  multiply,
  orthonormal,
  scale,
  subtract,
  toAngles,
} from "./rotation.js";

/** Minimum length of a box's sides, metres. */
export const MIN_SIZE_M = 0.01;
/** The arrow of the heading ends so far in front of the box, share of its mean side, as geometry/oriented_box.py. */
const ARROW_BEYOND = 0.2;

// the same order as the server: --- +-- ++- -+- --+ +-+ +++ -++
const SIGNS = [
  [-1, -1, -1],
  [1, -1, -1],
  [1, 1, -1],
  [-1, 1, -1],
  [-1, -1, 1],
  [1, -1, 1],
  [1, 1, 1],
  [-1, 1, 1],
];

/** The 12 edges by the numbers of their corners: bottom, top, uprights. */
export const EDGES = [
  [0, 1],
  [1, 2],
  [2, 3],
  [3, 0],
  [4, 5],
  [5, 6],
  [6, 7],
  [7, 4],
  [0, 4],
  [1, 5],
  [2, 6],
  [3, 7],
];

/**
 * A copy that shares nothing with the box.
 *
 * @param {Box3D} box
 */
export function copyBox({ center, size, rotation }) {
  return { center: [...center], size: [...size], rotation: rotation.map((row) => [...row]) };
}

/**
 * The box axis `i` as a unit vector in the camera frame.
 *
 * @param {Box3D} box
 * @param {number} i
 */
export const boxAxis = (box, i) => column(box.rotation, i);

/**
 * The 8 corners, camera frame.
 *
 * @param {Box3D} box
 */
export function corners(box) {
  const half = [0, 1, 2].map((i) => scale(boxAxis(box, i), box.size[i] / 2));
  return SIGNS.map((sign) => half.reduce((point, side, i) => add(point, scale(side, sign[i])), box.center));
}

/**
 * The arrow that shows the heading: from the middle of the box through its front (the +x face).
 *
 * @param {Box3D} box
 */
export function headingArrow(box) {
  const mean = (box.size[0] + box.size[1] + box.size[2]) / 3;
  return [box.center, add(box.center, scale(boxAxis(box, 0), box.size[0] / 2 + ARROW_BEYOND * mean))];
}

/**
 * Whether two boxes agree within a tolerance in metres, in their centres, their sizes, and the shift of their ends by
 * the rotation between them.
 *
 * @param {Box3D} a
 * @param {Box3D} b
 * @param {number} [toleranceM]
 */
export function sameBox(a, b, toleranceM = 1e-6) {
  const turned = (angleBetween(a.rotation, b.rotation) * Math.max(...b.size)) / 2;
  const sizes = a.size.map((value, i) => Math.abs(value - b.size[i]));
  return Math.max(length(subtract(a.center, b.center)), turned, ...sizes) <= toleranceM;
}

// -- on a view

/**
 * The position of a point of the camera frame on a view, px.
 *
 * @param {Plane} view
 * @param {Vector} point
 */
export function toView(view, point) {
  return [0, 1].map((i) => (dot(view.axes[i], point) - view.origin_m[i]) / view.metres_per_px);
}

/**
 * The arrow of a box's heading on a view, px. It ends within the box, where no handle hides it.
 *
 * @param {Plane} view
 * @param {Box3D} box
 * @returns {Arrow}
 */
export function viewHeading(view, box) {
  const x = boxAxis(box, 0);
  const [from, to] = [0, 0.4].map((share) => toView(view, add(box.center, scale(x, share * box.size[0]))));
  return { from, to, sight: dot(view.axes[2], x) };
}

/**
 * The rectangle around a box on a view: {x_min, y_min, x_max, y_max}, px.
 *
 * @param {Plane} view
 * @param {Box3D} box
 */
export function viewRect(view, box) {
  const spans = [0, 1].map((i) =>
    spanAlong(box, view.axes[i]).map((m) => (m - view.origin_m[i]) / view.metres_per_px),
  );
  return { x_min: spans[0][0], y_min: spans[1][0], x_max: spans[0][1], y_max: spans[1][1] };
}

/**
 * The 12 edges of a box on a view: pairs of points, px.
 *
 * @param {Plane} view
 * @param {Box3D} box
 */
export function viewOutline(view, box) {
  const px = corners(box).map((point) => toView(view, point));
  return EDGES.map(([a, b]) => [px[a], px[b]]);
}

/**
 * The interval that a box covers along a unit vector, metres.
 *
 * @param {Box3D} box
 * @param {Vector} direction
 */
function spanAlong(box, direction) {
  const middle = dot(direction, box.center);
  const half = [0, 1, 2].reduce((sum, i) => sum + (box.size[i] / 2) * Math.abs(dot(direction, boxAxis(box, i))), 0);
  return [middle - half, middle + half];
}

/**
 * The box that covers `low` to `high` along a direction; the side that is most parallel to it is changed.
 *
 * @param {Box3D} box
 * @param {Vector} direction
 * @param {number} low
 * @param {number} high
 */
function withSpan(box, direction, low, high) {
  const shares = [0, 1, 2].map((i) => Math.abs(dot(direction, boxAxis(box, i))));
  const k = shares.indexOf(Math.max(...shares));
  const others = [0, 1, 2].reduce((sum, i) => sum + (i === k ? 0 : box.size[i] * shares[i]), 0);
  const size = [...box.size];
  size[k] = Math.max((high - low - others) / shares[k], MIN_SIZE_M);
  const shift = (low + high) / 2 - dot(direction, box.center);
  return { ...box, size, center: add(box.center, scale(direction, shift)) };
}

/**
 * The box after its rectangle on a view has become `rect` (px). Its extent along the line of sight does not change,
 * nor does any side of the box whose edge did not move.
 *
 * @param {Plane} view
 * @param {Box3D} box
 * @param {Rect} rect
 */
export function withViewRect(view, box, rect) {
  const before = viewRect(view, box);
  /**
   * @param {number} px
   * @param {number} i
   */
  const metres = (px, i) => view.origin_m[i] + px * view.metres_per_px;
  let after = copyBox(box);
  if (rect.x_min !== before.x_min || rect.x_max !== before.x_max) {
    after = withSpan(after, view.axes[0], metres(rect.x_min, 0), metres(rect.x_max, 0));
  }
  if (rect.y_min !== before.y_min || rect.y_max !== before.y_max) {
    after = withSpan(after, view.axes[1], metres(rect.y_min, 1), metres(rect.y_max, 1));
  }
  return after;
}

/**
 * The box turned about its centre and a unit vector of the camera frame.
 *
 * @param {Box3D} box
 * @param {Vector} axis
 * @param {number} angleRad
 */
export function turned(box, axis, angleRad) {
  return { ...copyBox(box), rotation: orthonormal(multiply(aboutAxis(axis, angleRad), box.rotation)) };
}

/**
 * The box after a view's rotation handle was turned by an angle, clockwise on the screen (x to y).
 *
 * @param {Plane} view
 * @param {Box3D} box
 * @param {number} angleRad
 */
export const turnedInView = (view, box, angleRad) => turned(box, view.axes[2], angleRad);

/**
 * The same cuboid with its heading turned by 90 degrees about z: length and width are swapped.
 *
 * @param {Box3D} box
 */
export function headingTurned(box) {
  const [x, y, z] = [0, 1, 2].map((i) => boxAxis(box, i));
  return {
    center: [...box.center],
    size: [box.size[1], box.size[0], box.size[2]],
    rotation: fromColumns(y, scale(x, -1), z),
  };
}

// -- as numbers in a form

const DEGREES = 180 / Math.PI;
/** @param {number} value */
const tidy = (value) => (Object.is(value, -0) ? 0 : value);

/**
 * {yaw, pitch, roll} in degrees; see `toAngles` for what they mean.
 *
 * @param {Box3D} box
 * @param {Vector | null} up
 */
export function anglesDeg(box, up) {
  const { yaw, pitch, roll } = toAngles(box.rotation, up);
  return { yaw: tidy(yaw * DEGREES), pitch: tidy(pitch * DEGREES), roll: tidy(roll * DEGREES) };
}

/**
 * The box with these angles in degrees.
 *
 * @param {Box3D} box
 * @param {Vector | null} up
 * @param {Angles} angles
 */
export function withAnglesDeg(box, up, { yaw, pitch, roll }) {
  const angles = { yaw: yaw / DEGREES, pitch: pitch / DEGREES, roll: roll / DEGREES };
  return { ...copyBox(box), rotation: fromAngles(angles, up) };
}
