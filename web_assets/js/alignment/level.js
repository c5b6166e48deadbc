// The up direction as roll and pitch of the camera, and the lines that show it. Pure functions; angles are degrees.

import { add, cross, dot, scale, subtract, unit } from "../rotation.js";

export const RAD = Math.PI / 180;
/** Lines of the grid in each direction. */
const LINES = 9;

/** The up direction of a camera that is rolled clockwise and pitched up by these angles. */
export function upOf(/** @type {{ roll: number, pitch: number }} */ { roll, pitch }) {
  const level = Math.cos(pitch * RAD);
  return [Math.sin(roll * RAD) * level, -Math.cos(roll * RAD) * level, Math.sin(pitch * RAD)];
}

export function anglesOf(/** @type {Vector} */ up) {
  const [x, y, z] = unit(up);
  return { roll: Math.atan2(x, -y) / RAD, pitch: Math.asin(Math.max(-1, Math.min(1, z))) / RAD };
}

/** A level grid through the lowest points, and plumb lines on some points: their two ends in the camera frame. */
export function levelLines(/** @type {Vector} */ up, /** @type {Vector[]} */ points) {
  if (points.length === 0) return { grid: [], plumb: [] };
  const heights = points.map((point) => dot(point, up));
  const floor = quantile(heights, 0.02);
  const distances = points.map((point, i) => Math.hypot(...subtract(point, scale(up, heights[i]))));
  const reach = quantile(distances, 0.7);
  const ahead = aheadOf(up) ?? unit(cross(up, [1, 0, 0]));
  const aside = cross(ahead, up);
  const centre = add(scale(up, floor), scale(ahead, 0.6 * reach));
  const at = (/** @type {number} */ i) => reach * ((2 * i) / (LINES - 1) - 1);
  const line = (/** @type {Vector} */ offset, /** @type {Vector} */ along) =>
    [-reach, reach].map((by) => add(offset, scale(along, by)));
  const grid = Array.from({ length: LINES }, (_, i) => i).flatMap((i) => [
    line(add(centre, scale(ahead, at(i))), aside),
    line(add(centre, scale(aside, at(i))), ahead),
  ]);
  const every = Math.max(1, Math.floor(points.length / 40));
  const plumb = points.filter((_, i) => i % every === 0).map((point) => [point, add(point, scale(up, 0.08 * reach))]);
  return { grid, plumb };
}

/** The horizon ahead, if it is seen, in short lines: far points at an equal height as the camera. */
export function horizon(/** @type {Vector} */ up) {
  const ahead = aheadOf(up);
  if (ahead === null) return [];
  const aside = cross(ahead, up);
  const at = (/** @type {number} */ degrees) =>
    add(scale(ahead, 1e4 * Math.cos(degrees * RAD)), scale(aside, 1e4 * Math.sin(degrees * RAD)));
  return Array.from({ length: 40 }, (_, i) => [at(4 * i - 80), at(4 * i - 76)]);
}

/** The level direction straight ahead; null: the camera looks up or down. */
function aheadOf(/** @type {Vector} */ up) {
  const axis = subtract([0, 0, 1], scale(up, up[2]));
  return Math.hypot(...axis) > 0.1 ? unit(axis) : null;
}

/** The value below which such a share of the values is. */
export function quantile(/** @type {number[]} */ values, /** @type {number} */ share) {
  return values.toSorted((a, b) => a - b)[Math.floor((values.length - 1) * share)];
}
