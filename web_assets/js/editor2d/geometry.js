/**
 * Boxes on a picture, in continuous pixels: the centre of the first pixel is (0, 0), so a picture spans -0.5 .. w - 0.5.
 * All functions are pure; a box is any object with x_min, y_min, x_max, y_max, and keeps its other properties.
 */

/** A box no thinner than this, pixels: a thinner one could not be told from a line. */
export const MIN_SIDE_PX = 0.5;

export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** The limits of a picture's boxes; infinite where boxes may leave it. */
export function pictureLimits({ width, height }, is_clipped) {
  if (!is_clipped || !width) return { x_min: -Infinity, y_min: -Infinity, x_max: Infinity, y_max: Infinity };
  return { x_min: -0.5, y_min: -0.5, x_max: width - 0.5, y_max: height - 0.5 };
}

export function clampPoint([x, y], limits) {
  return [clamp(x, limits.x_min, limits.x_max), clamp(y, limits.y_min, limits.y_max)];
}

/** The edges of the box with these two corners. */
export function edgesBetween([ax, ay], [bx, by]) {
  return { x_min: Math.min(ax, bx), y_min: Math.min(ay, by), x_max: Math.max(ax, bx), y_max: Math.max(ay, by) };
}

/** A box shifted as a whole, as far as the limits let it. */
export function moved(box, dx, dy, limits) {
  const x = clampShift(dx, box.x_min, box.x_max, limits.x_min, limits.x_max);
  const y = clampShift(dy, box.y_min, box.y_max, limits.y_min, limits.y_max);
  return { ...box, x_min: box.x_min + x, x_max: box.x_max + x, y_min: box.y_min + y, y_max: box.y_max + y };
}

/** A box that already reaches beyond a limit may still come back. */
function clampShift(shift, low, high, limit_low, limit_high) {
  return clamp(shift, Math.min(limit_low - low, 0), Math.max(limit_high - high, 0));
}

/**
 * A box whose edges on one side (-1, 0, 1 in x and y) are shifted; an edge that is pulled over the opposite one changes
 * places with it.
 */
export function resized(box, side_x, side_y, dx, dy, limits) {
  const [x_min, x_max] = shiftedEdge(box.x_min, box.x_max, side_x, dx, limits.x_min, limits.x_max);
  const [y_min, y_max] = shiftedEdge(box.y_min, box.y_max, side_y, dy, limits.y_min, limits.y_max);
  return { ...box, x_min, y_min, x_max, y_max };
}

function shiftedEdge(low, high, side, shift, limit_low, limit_high) {
  if (side === 0) return [low, high];
  const [fixed, edge] = side < 0 ? [high, low] : [low, high];
  let pulled = clamp(edge + shift, Math.min(limit_low, edge), Math.max(limit_high, edge));
  if (Math.abs(pulled - fixed) < MIN_SIDE_PX) pulled = fixed + (side < 0 ? -MIN_SIDE_PX : MIN_SIDE_PX);
  return pulled < fixed ? [pulled, fixed] : [fixed, pulled];
}

export const widthOf = (box) => box.x_max - box.x_min;
export const heightOf = (box) => box.y_max - box.y_min;

export function isInside(box, [x, y]) {
  return x >= box.x_min && x <= box.x_max && y >= box.y_min && y <= box.y_max;
}

/**
 * Which edges of a box a point is near: {side_x, side_y}, or null. At a corner both are set; an edge counts along its
 * whole length.
 *
 * @param {number} reach how near, in the units of the box.
 */
export function edgeNear(box, [x, y], reach, { edges = true, corners = true } = {}) {
  if (x < box.x_min - reach || x > box.x_max + reach || y < box.y_min - reach || y > box.y_max + reach) return null;
  // On a small box, its inner half stays free for moving it.
  const reach_x = Math.min(reach, widthOf(box) / 4);
  const reach_y = Math.min(reach, heightOf(box) / 4);
  const side_x = nearSide(x, box.x_min, box.x_max, reach, reach_x);
  const side_y = nearSide(y, box.y_min, box.y_max, reach, reach_y);
  if (side_x !== 0 && side_y !== 0) return corners ? { side_x, side_y } : null;
  if (side_x !== 0 || side_y !== 0) return edges ? { side_x, side_y } : null;
  return null;
}

function nearSide(value, low, high, outer, inner) {
  if (value >= low - outer && value <= low + inner) return -1;
  if (value >= high - inner && value <= high + outer) return 1;
  return 0;
}

/** The convex hull of points, counter-clockwise; monotone chain. */
export function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (list) => {
    const chain = [];
    for (const point of list) {
      while (chain.length > 1 && cross(chain.at(-2), chain.at(-1), point) <= 0) chain.pop();
      chain.push(point);
    }
    return chain.slice(0, -1);
  };
  return sorted.length < 3 ? sorted : [...half(sorted), ...half(sorted.reverse())];
}

const cross = ([ox, oy], [ax, ay], [bx, by]) => (ax - ox) * (by - oy) - (ay - oy) * (bx - ox);

/** Twice the signed area of a polygon. */
export const area2 = (polygon) => polygon.reduce((sum, [x, y], i) => sum + x * polygon[(i + 1) % polygon.length][1] - polygon[(i + 1) % polygon.length][0] * y, 0);

export function isInHull(polygon, point) {
  return polygon.length > 2 && polygon.every((corner, i) => cross(corner, polygon[(i + 1) % polygon.length], point) >= 0);
}
