// Vectors, rotation matrices and quaternions: plain arrays, pure functions.
//
// A vector is [x, y, z]. A matrix is three rows; for a box's rotation its columns are the box axes in the camera
// frame. Quaternions are [w, x, y, z]. Angles are radians.

export const IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);

export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** The vector with length 1. */
export const unit = (a) => scale(a, 1 / length(a));

/** matrix . vector */
export const apply = (matrix, vector) => matrix.map((row) => dot(row, vector));

export const transpose = (m) => [0, 1, 2].map((i) => [m[0][i], m[1][i], m[2][i]]);

/** Column `i` of a matrix: a box axis in the camera frame. */
export const column = (m, i) => [m[0][i], m[1][i], m[2][i]];

/** The matrix with these columns. */
export const fromColumns = (x, y, z) => transpose([x, y, z]);

/** a . b */
export function multiply(a, b) {
  const columns = transpose(b);
  return a.map((row) => columns.map((other) => dot(row, other)));
}

/** The rotation by `angle_rad` about a unit vector, right-handed (Rodrigues' formula). */
export function aboutAxis(axis, angle_rad) {
  const [x, y, z] = axis;
  const c = Math.cos(angle_rad);
  const s = Math.sin(angle_rad);
  const t = 1 - c;
  return [
    [c + x * x * t, x * y * t - z * s, x * z * t + y * s],
    [y * x * t + z * s, c + y * y * t, y * z * t - x * s],
    [z * x * t - y * s, z * y * t + x * s, c + z * z * t],
  ];
}

/** The nearest-looking proper rotation: Gram-Schmidt on the columns, z last. Undoes the rounding of many products. */
export function orthonormal(m) {
  const x = unit(column(m, 0));
  const y0 = column(m, 1);
  const y = unit(subtract(y0, scale(x, dot(x, y0))));
  return fromColumns(x, y, cross(x, y));
}

export function fromQuaternion([w, x, y, z]) {
  const n = Math.hypot(w, x, y, z);
  const [a, b, c, d] = [w / n, x / n, y / n, z / n];
  return [
    [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
    [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
    [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
  ];
}

/** [w, x, y, z] with w >= 0. The biggest of the four is found first, so that nothing is divided by almost zero. */
export function toQuaternion(m) {
  const trace = m[0][0] + m[1][1] + m[2][2];
  const squares = [trace, m[0][0], m[1][1], m[2][2]];
  const i = squares.indexOf(Math.max(...squares));
  let q;
  if (i === 0) {
    q = [1 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
  } else if (i === 1) {
    q = [m[2][1] - m[1][2], 1 + 2 * m[0][0] - trace, m[0][1] + m[1][0], m[0][2] + m[2][0]];
  } else if (i === 2) {
    q = [m[0][2] - m[2][0], m[0][1] + m[1][0], 1 + 2 * m[1][1] - trace, m[1][2] + m[2][1]];
  } else {
    q = [m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1 + 2 * m[2][2] - trace];
  }
  const n = Math.hypot(...q) * (q[0] < 0 ? -1 : 1);
  return q.map((value) => value / n);
}

/** The angle between two rotations, radians. */
export function angleBetween(a, b) {
  const relative = multiply(transpose(a), b);
  const cosine = (relative[0][0] + relative[1][1] + relative[2][2] - 1) / 2;
  const [x, y, z] = [relative[2][1] - relative[1][2], relative[0][2] - relative[2][0], relative[1][0] - relative[0][1]];
  return Math.atan2(Math.hypot(x, y, z) / 2, cosine);
}

/**
 * Columns: forward, left and up of the scene in the camera frame. Forward is the camera's viewing direction made
 * level; where the camera looks along the vertical, its own upper edge takes that part.
 *
 * @param up the scene's up direction in the camera frame, or null where it is unknown: then up is the picture's.
 */
export function sceneFrame(up) {
  const z = unit(up ?? [0, -1, 0]);
  const level = (direction) => subtract(direction, scale(z, dot(z, direction)));
  const ahead = level([0, 0, 1]);
  const x = unit(length(ahead) > 1e-3 ? ahead : level([0, -1, 0]));
  return fromColumns(x, cross(z, x), z);
}

/**
 * Yaw, pitch and roll of a rotation, radians: R = scene . Rz(yaw) . Ry(pitch) . Rx(roll). Yaw turns about the scene's
 * up and is 0 where the x axis points away from the camera; pitch lowers the x axis' end; roll turns about x.
 */
export function toAngles(rotation, up) {
  const m = multiply(transpose(sceneFrame(up)), rotation);
  const pitch = Math.asin(Math.max(-1, Math.min(1, -m[2][0])));
  if (Math.abs(m[2][0]) > 1 - 1e-9) {
    // x is vertical: yaw and roll turn about the same line, all of it is called yaw
    return { yaw: Math.atan2(-m[0][1], m[1][1]), pitch, roll: 0 };
  }
  return { yaw: Math.atan2(m[1][0], m[0][0]), pitch, roll: Math.atan2(m[2][1], m[2][2]) };
}

/** The rotation of `toAngles`. */
export function fromAngles({ yaw, pitch, roll }, up) {
  const turn = (axis, angle) => aboutAxis(IDENTITY[axis], angle);
  return orthonormal(multiply(sceneFrame(up), multiply(turn(2, yaw), multiply(turn(1, pitch), turn(0, roll)))));
}
