/**
 * Boxes on a picture, in continuous pixels: the centre of the first pixel is (0, 0), so a picture spans -0.5 .. w -
 * 0.5. All functions are pure. A box keeps its other properties.
 */

/** Minimum side of a box, px: a narrower box looks like a line. */
const MIN_SIDE_PX = 0.5;

/**
 * @param {number} value
 * @param {number} low
 * @param {number} high
 */
export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/**
 * Limits for the boxes of a picture; infinite if boxes may extend beyond it.
 *
 * @param {Size} size
 * @param {boolean} isClipped
 */
export function pictureLimits({ width, height }, isClipped) {
  if (!isClipped || !width) return { x_min: -Infinity, y_min: -Infinity, x_max: Infinity, y_max: Infinity };
  return { x_min: -0.5, y_min: -0.5, x_max: width - 0.5, y_max: height - 0.5 };
}

/**
 * @param {Point} point
 * @param {Rect} limits
 */
export function clampPoint([x, y], limits) {
  return [clamp(x, limits.x_min, limits.x_max), clamp(y, limits.y_min, limits.y_max)];
}

/**
 * The edges of the box with these two corners.
 *
 * @param {Point} point
 * @param {Point} point2
 */
export function edgesBetween([ax, ay], [bx, by]) {
  return { x_min: Math.min(ax, bx), y_min: Math.min(ay, by), x_max: Math.max(ax, bx), y_max: Math.max(ay, by) };
}

/**
 * A box shifted as a whole, as far as the limits let it.
 *
 * @template {Rect} T
 * @param {T} box
 * @param {number} dx
 * @param {number} dy
 * @param {Rect} limits
 */
export function moved(box, dx, dy, limits) {
  const x = clampShift(dx, box.x_min, box.x_max, limits.x_min, limits.x_max);
  const y = clampShift(dy, box.y_min, box.y_max, limits.y_min, limits.y_max);
  return { ...box, x_min: box.x_min + x, x_max: box.x_max + x, y_min: box.y_min + y, y_max: box.y_max + y };
}

/**
 * The permitted part of a shift; a box that already extends beyond a limit may still be moved back.
 *
 * @param {number} shift
 * @param {number} low
 * @param {number} high
 * @param {number} limitLow
 * @param {number} limitHigh
 */
function clampShift(shift, low, high, limitLow, limitHigh) {
  return clamp(shift, Math.min(limitLow - low, 0), Math.max(limitHigh - high, 0));
}

/**
 * A box whose edges on one side (-1, 0, 1 in x and y) are shifted; an edge that is dragged beyond the opposite one
 * is swapped with it.
 *
 * @template {Rect} T
 * @param {T} box
 * @param {number} sideX
 * @param {number} sideY
 * @param {number} dx
 * @param {number} dy
 * @param {Rect} limits
 */
export function resized(box, sideX, sideY, dx, dy, limits) {
  const [left, right] = shiftedEdge(box.x_min, box.x_max, sideX, dx, limits.x_min, limits.x_max);
  const [top, bottom] = shiftedEdge(box.y_min, box.y_max, sideY, dy, limits.y_min, limits.y_max);
  return { ...box, x_min: left, y_min: top, x_max: right, y_max: bottom };
}

/**
 * @param {number} low
 * @param {number} high
 * @param {number} side
 * @param {number} shift
 * @param {number} limitLow
 * @param {number} limitHigh
 */
function shiftedEdge(low, high, side, shift, limitLow, limitHigh) {
  if (side === 0) return [low, high];
  const [fixed, edge] = side < 0 ? [high, low] : [low, high];
  let pulled = clamp(edge + shift, Math.min(limitLow, edge), Math.max(limitHigh, edge));
  if (Math.abs(pulled - fixed) < MIN_SIDE_PX) pulled = fixed + (side < 0 ? -MIN_SIDE_PX : MIN_SIDE_PX);
  return pulled < fixed ? [pulled, fixed] : [fixed, pulled];
}

/** @param {Rect} box */
export const widthOf = (box) => box.x_max - box.x_min;
/** @param {Rect} box */
export const heightOf = (box) => box.y_max - box.y_min;

/**
 * @param {Rect} box
 * @param {Point} point
 */
export function isInside(box, [x, y]) {
  return x >= box.x_min && x <= box.x_max && y >= box.y_min && y <= box.y_max;
}

/**
 * Which edges of a box a point is near: {sideX, sideY}, or null. At a corner both are set; an edge counts along its
 * whole length.
 *
 * @param {Rect} box
 * @param {Point} point
 * @param {number} reach maximum distance, in the units of the box.
 * @param {Partial<Handles>} [handles]
 */
export function edgeNear(box, [x, y], reach, { edges = true, corners = true } = {}) {
  if (x < box.x_min - reach || x > box.x_max + reach || y < box.y_min - reach || y > box.y_max + reach) return null;
  // dragging the inner half of a small box still moves it
  const reachX = Math.min(reach, widthOf(box) / 4);
  const reachY = Math.min(reach, heightOf(box) / 4);
  const sideX = nearSide(x, box.x_min, box.x_max, reach, reachX);
  const sideY = nearSide(y, box.y_min, box.y_max, reach, reachY);
  if (sideX !== 0 && sideY !== 0) return corners ? { sideX, sideY } : null;
  if (sideX !== 0 || sideY !== 0) return edges ? { sideX, sideY } : null;
  return null;
}

/**
 * @param {number} value
 * @param {number} low
 * @param {number} high
 * @param {number} outer
 * @param {number} inner
 */
function nearSide(value, low, high, outer, inner) {
  if (value >= low - outer && value <= low + inner) return -1;
  if (value >= high - inner && value <= high + outer) return 1;
  return 0;
}

/**
 * The convex hull of points, counter-clockwise; monotone chain.
 *
 * @param {Point[]} points
 */
export function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  /** @param {Point[]} list */
  const half = (list) => {
    /** @type {Point[]} */
    const chain = [];
    for (const point of list) {
      while (chain.length > 1 && cross(chain[chain.length - 2], chain[chain.length - 1], point) <= 0) chain.pop();
      chain.push(point);
    }
    return chain.slice(0, -1);
  };
  return sorted.length < 3 ? sorted : [...half(sorted), ...half(sorted.reverse())];
}

/**
 * @param {Point} point
 * @param {Point} point2
 * @param {Point} point3
 */
const cross = ([ox, oy], [ax, ay], [bx, by]) => (ax - ox) * (by - oy) - (ay - oy) * (bx - ox);

/**
 * Twice the signed area of a polygon.
 *
 * @param {Point[]} polygon
 */
export const area2 = (polygon) =>
  polygon.reduce(
    (sum, [x, y], i) => sum + x * polygon[(i + 1) % polygon.length][1] - polygon[(i + 1) % polygon.length][0] * y,
    0,
  );

/**
 * @param {Point[]} polygon
 * @param {Point} point
 */
export function isInHull(polygon, point) {
  return (
    polygon.length > 2 && polygon.every((corner, i) => cross(corner, polygon[(i + 1) % polygon.length], point) >= 0)
  );
}
