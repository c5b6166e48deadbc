// Vectors and rotation matrices: plain arrays, pure functions.
//
// A vector is [x, y, z]. A matrix is three rows; the columns of a box's rotation are its axes in the camera frame.
// Angles are radians.

export const IDENTITY = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];

export const add = (/** @type {Vector} */ a, /** @type {Vector} */ b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const subtract = (/** @type {Vector} */ a, /** @type {Vector} */ b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (/** @type {Vector} */ a, /** @type {number} */ factor) => [
  a[0] * factor,
  a[1] * factor,
  a[2] * factor,
];
export const dot = (/** @type {Vector} */ a, /** @type {Vector} */ b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (/** @type {Vector} */ a) => Math.hypot(a[0], a[1], a[2]);

export function cross(/** @type {Vector} */ a, /** @type {Vector} */ b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** The vector with length 1. */
export const unit = (/** @type {Vector} */ a) => scale(a, 1 / length(a));

export const transpose = (/** @type {Matrix} */ m) => [0, 1, 2].map((i) => [m[0][i], m[1][i], m[2][i]]);

/** Column `i` of a matrix: a box axis in the camera frame. */
export const column = (/** @type {Matrix} */ m, /** @type {number} */ i) => [m[0][i], m[1][i], m[2][i]];

/** The matrix with these columns. */
export const fromColumns = (/** @type {Vector} */ x, /** @type {Vector} */ y, /** @type {Vector} */ z) =>
  transpose([x, y, z]);

/** a . b */
export function multiply(/** @type {Matrix} */ a, /** @type {Matrix} */ b) {
  const columns = transpose(b);
  return a.map((row) => columns.map((other) => dot(row, other)));
}

/** The rotation by `angleRad` about a unit vector, right-handed (Rodrigues' formula). */
export function aboutAxis(/** @type {Vector} */ axis, /** @type {number} */ angleRad) {
  const [x, y, z] = axis;
  const c = Math.cos(angleRad);
  const s = Math.sin(angleRad);
  const t = 1 - c;
  return [
    [c + x * x * t, x * y * t - z * s, x * z * t + y * s],
    [y * x * t + z * s, c + y * y * t, y * z * t - x * s],
    [z * x * t - y * s, z * y * t + x * s, c + z * z * t],
  ];
}

/** Gram-Schmidt on the columns, z last: removes the rounding errors of many products. */
export function orthonormal(/** @type {Matrix} */ m) {
  const x = unit(column(m, 0));
  const y0 = column(m, 1);
  const y = unit(subtract(y0, scale(x, dot(x, y0))));
  return fromColumns(x, y, cross(x, y));
}

/** The angle between two rotations, radians. */
export function angleBetween(/** @type {Matrix} */ a, /** @type {Matrix} */ b) {
  const relative = multiply(transpose(a), b);
  const cosine = (relative[0][0] + relative[1][1] + relative[2][2] - 1) / 2;
  const [x, y, z] = [
    relative[2][1] - relative[1][2],
    relative[0][2] - relative[2][0],
    relative[1][0] - relative[0][1],
  ];
  return Math.atan2(Math.hypot(x, y, z) / 2, cosine);
}

/**
 * The scene's axes as columns in the camera frame: forward, left, up. Forward is the camera's viewing direction, made
 * level; if the camera looks straight up or down, it is the direction of the picture's upper edge.
 *
 * @param {Vector | null} up the scene's up direction in the camera frame; null if it is unknown: then the
 *     picture's.
 */
export function sceneAxes(up) {
  const z = unit(up ?? [0, -1, 0]);
  const level = (/** @type {Vector} */ direction) => subtract(direction, scale(z, dot(z, direction)));
  const ahead = level([0, 0, 1]);
  const x = unit(length(ahead) > 1e-3 ? ahead : level([0, -1, 0]));
  return fromColumns(x, cross(z, x), z);
}

/** The yaw of a direction, radians: about the scene's up, 0 if it points away from the camera. */
export function yawOf(/** @type {Vector} */ direction, /** @type {Vector | null} */ up) {
  const [ahead, left] = transpose(sceneAxes(up)).map((axis) => dot(axis, direction));
  return Math.atan2(left, ahead);
}

/**
 * Yaw, pitch and roll of a rotation, radians: R = scene . Rz(yaw) . Ry(pitch) . Rx(roll). Yaw turns about the scene's
 * up and is 0 where the x axis points away from the camera; a positive pitch lowers the x axis; roll turns about x.
 */
export function toAngles(/** @type {Matrix} */ rotation, /** @type {Vector | null} */ up) {
  const m = multiply(transpose(sceneAxes(up)), rotation);
  const pitch = Math.asin(Math.max(-1, Math.min(1, -m[2][0])));
  if (Math.abs(m[2][0]) > 1 - 1e-9) {
    // x is vertical: yaw and roll are about the same axis, and the whole rotation counts as yaw
    return { yaw: Math.atan2(-m[0][1], m[1][1]), pitch, roll: 0 };
  }
  return { yaw: Math.atan2(m[1][0], m[0][0]), pitch, roll: Math.atan2(m[2][1], m[2][2]) };
}

/** The rotation of `toAngles`. */
export function fromAngles(/** @type {Angles} */ { yaw, pitch, roll }, /** @type {Vector | null} */ up) {
  const turn = (/** @type {number} */ axis, /** @type {number} */ angle) => aboutAxis(IDENTITY[axis], angle);
  return orthonormal(multiply(sceneAxes(up), multiply(turn(2, yaw), multiply(turn(1, pitch), turn(0, roll)))));
}
