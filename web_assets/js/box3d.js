// Oriented boxes and their orthogonal views: pure functions that return a new box and never change the old one.

import {
  IDENTITY,
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
  transpose,
} from "./rotation.js";

/** Minimum length of a box's sides, metres. */
export const MIN_SIZE_M = 0.01;
/** The arrow of the heading ends so far in front of the box, share of its mean side, as geometry/oriented_box.py. */
const ARROW_BEYOND = 0.2;
const JUMP_DEG = 120;
const DEGREES = 180 / Math.PI;

// the same order as the server
const SIGNS = ["---", "+--", "++-", "-+-", "--+", "+-+", "+++", "-++"].map((signs) =>
  [...signs].map((sign) => (sign === "+" ? 1 : -1)),
);

const RING = [0, 1, 2, 3];
/** The 12 edges by the numbers of their corners: bottom, top, uprights. */
export const EDGES = [
  ...RING.map((i) => [i, (i + 1) % 4]),
  ...RING.map((i) => [4 + i, 4 + ((i + 1) % 4)]),
  ...RING.map((i) => [i, 4 + i]),
];

/** A copy that shares nothing with the box. */
export function copyBox(/** @type {Box3D} */ { center, size, rotation }) {
  return { center: [...center], size: [...size], rotation: rotation.map((row) => [...row]) };
}

/** The box axis `i` as a unit vector in the camera frame. */
export const boxAxis = (/** @type {Box3D} */ box, /** @type {number} */ i) => column(box.rotation, i);

/** The 8 corners, camera frame. */
export function corners(/** @type {Box3D} */ box) {
  const half = [0, 1, 2].map((i) => scale(boxAxis(box, i), box.size[i] / 2));
  return SIGNS.map((sign) => half.reduce((point, side, i) => add(point, scale(side, sign[i])), box.center));
}

/** The arrow that shows the heading: on the ground (-z) face, from its middle through the front (+x). */
export function headingArrow(/** @type {Box3D} */ box) {
  const mean = (box.size[0] + box.size[1] + box.size[2]) / 3;
  const foot = add(box.center, scale(boxAxis(box, 2), -box.size[2] / 2));
  return [foot, add(foot, scale(boxAxis(box, 0), box.size[0] / 2 + ARROW_BEYOND * mean))];
}

/**
 * How far a box is turned from the one beside it in its track, degrees, if that is more than an object turns; else
 * null. As the check of headings (workflows/checking).
 */
export function headingJump(
  /** @type {{ box: Box3D, heading_beside: Vector | null }} */ { box, heading_beside: other },
) {
  const cosine = other ? dot(boxAxis(box, 0), other) : 1;
  const turnDeg = Math.acos(Math.max(-1, Math.min(1, cosine))) * DEGREES;
  return turnDeg > JUMP_DEG ? turnDeg : null;
}

/**
 * Whether two boxes agree within a tolerance in metres, in their centres, their sizes, and the shift of their ends by
 * the rotation between them.
 */
export function sameBox(/** @type {Box3D} */ a, /** @type {Box3D} */ b, /** @type {number} */ toleranceM = 1e-6) {
  const turned = (angleBetween(a.rotation, b.rotation) * Math.max(...b.size)) / 2;
  const sizes = a.size.map((value, i) => Math.abs(value - b.size[i]));
  return Math.max(length(subtract(a.center, b.center)), turned, ...sizes) <= toleranceM;
}

/**
 * A box in the frame of another camera of the moment; each camera's matrix is from the frame of their cloud, or null.
 *
 * @param {Box3D} box
 * @param {Matrix | null} from of the camera in whose frame the box is.
 * @param {Matrix | null} to
 * @returns {Box3D}
 */
export function carried(box, from, to) {
  const [before, start] = split(from);
  const [after, end] = split(to);
  const turn = multiply(after, transpose(before));
  const place = (/** @type {Vector} */ point) => turn.map((row) => dot(row, point));
  return {
    center: add(place(subtract(box.center, start)), end),
    size: [...box.size],
    rotation: multiply(turn, box.rotation),
  };
}

/** Rotation and translation of a 4 x 4 matrix; null: of the identity. @returns {[Matrix, Vector]} */
const split = (/** @type {Matrix | null} */ matrix) =>
  matrix === null
    ? [IDENTITY, [0, 0, 0]]
    : [[0, 1, 2].map((i) => matrix[i].slice(0, 3)), [0, 1, 2].map((i) => matrix[i][3])];

// -- on a view

/** The position of a point of the camera frame on a view, px. */
export function toView(/** @type {Plane} */ view, /** @type {Vector} */ point) {
  return [0, 1].map((i) => (dot(view.axes[i], point) - view.origin_m[i]) / view.metres_per_px);
}

/** The arrow of a box's heading on a view, px. It ends within the box, where no handle hides it. @returns {Arrow} */
export function viewHeading(/** @type {Plane} */ view, /** @type {Box3D} */ box) {
  const x = boxAxis(box, 0);
  const [from, to] = [0, 0.4].map((share) => toView(view, add(box.center, scale(x, share * box.size[0]))));
  return { from, to, sight: dot(view.axes[2], x) };
}

/** The rectangle around a box on a view: {x_min, y_min, x_max, y_max}, px. */
export function viewRect(/** @type {Plane} */ view, /** @type {Box3D} */ box) {
  const spans = [0, 1].map((i) =>
    spanAlong(box, view.axes[i]).map((m) => (m - view.origin_m[i]) / view.metres_per_px),
  );
  return { x_min: spans[0][0], y_min: spans[1][0], x_max: spans[0][1], y_max: spans[1][1] };
}

/** The 12 edges of a box on a view: pairs of points, px. */
export function viewOutline(/** @type {Plane} */ view, /** @type {Box3D} */ box) {
  const px = corners(box).map((point) => toView(view, point));
  return EDGES.map(([a, b]) => [px[a], px[b]]);
}

/** The interval that a box covers along a unit vector, metres. */
function spanAlong(/** @type {Box3D} */ box, /** @type {Vector} */ direction) {
  const middle = dot(direction, box.center);
  const half = [0, 1, 2].reduce((sum, i) => sum + (box.size[i] / 2) * Math.abs(dot(direction, boxAxis(box, i))), 0);
  return [middle - half, middle + half];
}

/** The box that covers `low` to `high` along a direction; the side that is most parallel to it is changed. */
function withSpan(
  /** @type {Box3D} */ box,
  /** @type {Vector} */ direction,
  /** @type {number} */ low,
  /** @type {number} */ high,
) {
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
 */
export function withViewRect(/** @type {Plane} */ view, /** @type {Box3D} */ box, /** @type {Rect} */ rect) {
  const before = viewRect(view, box);
  const metres = (/** @type {number} */ px, /** @type {number} */ i) => view.origin_m[i] + px * view.metres_per_px;
  let after = copyBox(box);
  if (rect.x_min !== before.x_min || rect.x_max !== before.x_max) {
    after = withSpan(after, view.axes[0], metres(rect.x_min, 0), metres(rect.x_max, 0));
  }
  if (rect.y_min !== before.y_min || rect.y_max !== before.y_max) {
    after = withSpan(after, view.axes[1], metres(rect.y_min, 1), metres(rect.y_max, 1));
  }
  return after;
}

/** The box turned about its centre and a unit vector of the camera frame; about a view's line of sight: clockwise. */
export function turned(/** @type {Box3D} */ box, /** @type {Vector} */ axis, /** @type {number} */ angleRad) {
  return { ...copyBox(box), rotation: orthonormal(multiply(aboutAxis(axis, angleRad), box.rotation)) };
}

/**
 * The same cuboid with its heading turned by so many quarters about z, so that the same points are inside: by one,
 * length and width are swapped.
 *
 * @returns {Box3D}
 */
export function headingTurned(/** @type {Box3D} */ box, /** @type {number} */ quarters) {
  if (quarters === 0) return copyBox(box);
  const [x, y, z] = [0, 1, 2].map((i) => boxAxis(box, i));
  const size = [box.size[1], box.size[0], box.size[2]];
  return headingTurned({ center: box.center, size, rotation: fromColumns(y, scale(x, -1), z) }, quarters - 1);
}

/** Whether two boxes fill the same space, whichever way they face. */
export const fillSame = (/** @type {Box3D} */ a, /** @type {Box3D} */ b) =>
  [0, 1, 2, 3].some((quarters) => sameBox(headingTurned(a, quarters), b));

// -- as numbers in a form

const tidy = (/** @type {number} */ value) => (Object.is(value, -0) ? 0 : value);

/** {yaw, pitch, roll} in degrees; see `toAngles` for what they mean. */
export function anglesDeg(/** @type {Box3D} */ box, /** @type {Vector | null} */ up) {
  const { yaw, pitch, roll } = toAngles(box.rotation, up);
  return { yaw: tidy(yaw * DEGREES), pitch: tidy(pitch * DEGREES), roll: tidy(roll * DEGREES) };
}

/** The box with these angles in degrees. */
export function withAnglesDeg(
  /** @type {Box3D} */ box,
  /** @type {Vector | null} */ up,
  /** @type {Angles} */ { yaw, pitch, roll },
) {
  const angles = { yaw: yaw / DEGREES, pitch: pitch / DEGREES, roll: roll / DEGREES };
  return { ...copyBox(box), rotation: fromAngles(angles, up) };
}
