// Projection onto the camera's picture, and the outline of a box on it, by OpenCV's camera model. The distortion has
// 0, 4, 5, 8, 12 or 14 coefficients.

import { EDGES, boxAxis, corners, headingArrow } from "./box3d.js";
import { dot, unit } from "./rotation.js";

/** The near plane: nearer points are not drawn, metres. */
const NEAR_M = 0.1;
/** Number of segments of an edge that lens distortion bends. */
const STEPS = 16;

/** The camera with its picture's size. @returns {Camera} */
export const cameraOf = (/** @type {Api.ImageJson} */ { camera, width, height }) => ({ ...camera, width, height });

/** A point's pixel coordinates; null if it is behind the camera or outside the range of the lens model. */
export function project(/** @type {Camera} */ camera, /** @type {Vector} */ [x, y, z]) {
  if (!(z > 0)) return null;
  const seen = distorted(camera, x / z, y / z);
  return seen && [seen[0] * camera.fx + camera.cx, seen[1] * camera.fy + camera.cy];
}

/** Whether straight lines are curved in the picture. */
const isBent = (/** @type {Camera} */ camera) => camera.distortion.some((value) => value !== 0);

/** Lines of two or more points (px) along the edges of a box, cut at the near plane and at the picture's border. */
export function outline(/** @type {Camera} */ camera, /** @type {Box3D} */ box) {
  const points = corners(box);
  return EDGES.flatMap(([a, b]) => line(camera, points[a], points[b]));
}

/** The arrow of a box's heading as far as it is on the picture; null if nothing of it is. @returns {Arrow | null} */
export function imageHeading(/** @type {Camera} */ camera, /** @type {Box3D} */ box) {
  const [middle, front] = headingArrow(box);
  const px = line(camera, middle, front).flat();
  const [from, to] = [px[0], px.at(-1)];
  return from && to ? { from, to, sight: dot(unit(box.center), boxAxis(box, 0)) } : null;
}

/** The parts of a straight line in the camera frame that are on the picture. */
export function line(/** @type {Camera} */ camera, /** @type {Vector} */ from, /** @type {Vector} */ to) {
  const ends = cutNear(from, to);
  if (!ends) return [];
  const count = isBent(camera) ? STEPS : 1;
  const [near, far] = ends;
  const px = Array.from({ length: count + 1 }, (_, i) => project(camera, between(near, far, i / count)));
  /** @type {Line[]} */
  const parts = [];
  for (let i = 0; i < count; i += 1) {
    const [a, b] = [px[i], px[i + 1]];
    const part = a && b && cutToPicture(camera, a, b);
    if (!part) continue;
    const last = parts.at(-1);
    const end = last?.at(-1);
    if (last && end && end[0] === part[0][0] && end[1] === part[0][1]) last.push(part[1]);
    else parts.push(part);
  }
  return parts;
}

const between = (/** @type {number[]} */ a, /** @type {number[]} */ b, /** @type {number} */ share) =>
  a.map((value, i) => value + share * (b[i] - value));

function cutNear(/** @type {Vector} */ a, /** @type {Vector} */ b) {
  if (a[2] < NEAR_M && b[2] < NEAR_M) return null;
  const crossing = () => between(a, b, (NEAR_M - a[2]) / (b[2] - a[2]));
  return [a[2] < NEAR_M ? crossing() : a, b[2] < NEAR_M ? crossing() : b];
}

/** The part of a line that is in the picture (Liang-Barsky clipping); null if there is none. */
function cutToPicture(/** @type {Camera} */ camera, /** @type {Point} */ a, /** @type {Point} */ b) {
  const low = [-0.5, -0.5];
  const high = [camera.width - 0.5, camera.height - 0.5];
  let [enter, leave] = [0, 1];
  for (const i of [0, 1]) {
    const along = b[i] - a[i];
    if (along === 0) {
      if (a[i] < low[i] || a[i] > high[i]) return null;
      continue;
    }
    const [first, second] = [(low[i] - a[i]) / along, (high[i] - a[i]) / along].sort((p, q) => p - q);
    enter = Math.max(enter, first);
    leave = Math.min(leave, second);
  }
  if (enter > leave) return null;
  return [enter === 0 ? a : between(a, b, enter), leave === 1 ? b : between(a, b, leave)];
}

function distorted(/** @type {Camera} */ camera, /** @type {number} */ x, /** @type {number} */ y) {
  if (!isBent(camera)) return [x, y];
  const k = [...camera.distortion, ...Array(14).fill(0)].slice(0, 14);
  const [k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty] = k;
  const q = x * x + y * y;
  if (q > (camera.most_q ?? Infinity)) return null;
  const factor = radialFactor([k1, k2, k3], q) / radialFactor([k4, k5, k6], q);
  const bent = [
    x * factor + 2 * p1 * x * y + p2 * (q + 2 * x * x) + q * (s1 + q * s2),
    y * factor + p1 * (q + 2 * y * y) + 2 * p2 * x * y + q * (s3 + q * s4),
  ];
  return tx || ty ? tilted(bent, tx, ty) : bent;
}

const radialFactor = (/** @type {number[]} */ [a, b, c], /** @type {number} */ q) => 1 + q * (a + q * (b + q * c));

/**
 * The tilted sensor of OpenCV's model: turned about x by tx, then about y by ty, and projected through the lens again.
 */
function tilted(/** @type {Point} */ [x, y], /** @type {number} */ tx, /** @type {number} */ ty) {
  const [cx, sx, cy, sy] = [Math.cos(tx), Math.sin(tx), Math.cos(ty), Math.sin(ty)];
  // the rows of the rotation in the documentation of OpenCV's calibration module
  const r = [
    [cy, sy * sx, -sy * cx],
    [0, cx, sx],
    [sy, -cy * sx, cy * cx],
  ];
  const [u, v, w] = r.map((row) => row[0] * x + row[1] * y + row[2]);
  return [(r[2][2] * u - r[0][2] * w) / w, (r[2][2] * v - r[1][2] * w) / w];
}
