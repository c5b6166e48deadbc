/**
 * Boxes on a picture, in continuous pixels: the centre of the first pixel is (0, 0), so a picture spans -0.5 .. w -
 * 0.5. All functions are pure. A box keeps its other properties.
 */

/** Minimum side of a box, px: a narrower box looks like a line. */
const MIN_SIDE_PX = 0.5;

const clamp = (/** @type {number} */ value, /** @type {number} */ low, /** @type {number} */ high) =>
  Math.min(Math.max(value, low), high);

/** Limits for the boxes of a picture; infinite if boxes may extend beyond it. */
export function pictureLimits(/** @type {Size} */ { width, height }, /** @type {boolean} */ isClipped) {
  if (!isClipped || !width) return { x_min: -Infinity, y_min: -Infinity, x_max: Infinity, y_max: Infinity };
  return { x_min: -0.5, y_min: -0.5, x_max: width - 0.5, y_max: height - 0.5 };
}

export function clampPoint(/** @type {Point} */ [x, y], /** @type {Rect} */ limits) {
  return [clamp(x, limits.x_min, limits.x_max), clamp(y, limits.y_min, limits.y_max)];
}

/** The edges of the box with these two corners. */
export function edgesBetween(/** @type {Point} */ [ax, ay], /** @type {Point} */ [bx, by]) {
  return { x_min: Math.min(ax, bx), y_min: Math.min(ay, by), x_max: Math.max(ax, bx), y_max: Math.max(ay, by) };
}

const xOf = (/** @type {Rect} */ { x_min, x_max }) => [x_min, x_max];
const yOf = (/** @type {Rect} */ { y_min, y_max }) => [y_min, y_max];

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
  const [left, right] = movedSpan(xOf(box), dx, xOf(limits));
  const [top, bottom] = movedSpan(yOf(box), dy, yOf(limits));
  return { ...box, x_min: left, y_min: top, x_max: right, y_max: bottom };
}

/** One that already extends beyond a limit may still be moved back. @type {(span: Point, by: number, limits: Point) => Point} */
function movedSpan([low, high], by, [least, most]) {
  const shift = clamp(by, Math.min(least - low, 0), Math.max(most - high, 0));
  return [low + shift, high + shift];
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
  const [left, right] = resizedSpan(xOf(box), sideX, dx, xOf(limits));
  const [top, bottom] = resizedSpan(yOf(box), sideY, dy, yOf(limits));
  return { ...box, x_min: left, y_min: top, x_max: right, y_max: bottom };
}

/** @type {(span: Point, side: number, by: number, limits: Point) => Point} */
function resizedSpan([low, high], side, by, [least, most]) {
  if (side === 0) return [low, high];
  const [fixed, edge] = side < 0 ? [high, low] : [low, high];
  let pulled = clamp(edge + by, Math.min(least, edge), Math.max(most, edge));
  if (Math.abs(pulled - fixed) < MIN_SIDE_PX) pulled = fixed + (side < 0 ? -MIN_SIDE_PX : MIN_SIDE_PX);
  return pulled < fixed ? [pulled, fixed] : [fixed, pulled];
}

export const widthOf = (/** @type {Rect} */ box) => box.x_max - box.x_min;
export const heightOf = (/** @type {Rect} */ box) => box.y_max - box.y_min;

export function isInside(/** @type {Rect} */ box, /** @type {Point} */ [x, y]) {
  return x >= box.x_min && x <= box.x_max && y >= box.y_min && y <= box.y_max;
}

/**
 * Which edges of a box a point is near: {sideX, sideY}, or null. At a corner both are set; an edge counts along its
 * whole length.
 *
 * @param {Rect} box
 * @param {Point} point
 * @param {number} reach maximum distance, in the units of the box.
 */
export function edgeNear(box, [x, y], reach) {
  if (x < box.x_min - reach || x > box.x_max + reach || y < box.y_min - reach || y > box.y_max + reach) return null;
  const sideX = nearSide(x, xOf(box), reach);
  const sideY = nearSide(y, yOf(box), reach);
  return sideX !== 0 || sideY !== 0 ? { sideX, sideY } : null;
}

/** @type {(value: number, span: Point, reach: number) => number} */
function nearSide(value, [low, high], reach) {
  // dragging the inner half of a small box still moves it
  const inner = Math.min(reach, (high - low) / 4);
  if (value >= low - reach && value <= low + inner) return -1;
  return value >= high - inner && value <= high + reach ? 1 : 0;
}

/** The convex hull of points, counter-clockwise; monotone chain. */
export function hull(/** @type {Point[]} */ points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (/** @type {Point[]} */ list) => {
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

const cross = (/** @type {Point} */ [ox, oy], /** @type {Point} */ [ax, ay], /** @type {Point} */ [bx, by]) =>
  (ax - ox) * (by - oy) - (ay - oy) * (bx - ox);

/** Twice the signed area of a polygon. */
export const area2 = (/** @type {Point[]} */ polygon) =>
  polygon.reduce(
    (sum, [x, y], i) => sum + x * polygon[(i + 1) % polygon.length][1] - polygon[(i + 1) % polygon.length][0] * y,
    0,
  );

export function isInHull(/** @type {Point[]} */ polygon, /** @type {Point} */ point) {
  return (
    polygon.length > 2 && polygon.every((corner, i) => cross(corner, polygon[(i + 1) % polygon.length], point) >= 0)
  );
}

// -- the picture in its window: window = offset + (px + 0.5) * scale, in CSS pixels

const MARGIN = 4;
const LARGEST_SCALE = 64;

/** `picture` and `size`, that of the window, may change. */
export function createView(/** @type {Size} */ picture, /** @type {Size} */ size) {
  const fitScale = () =>
    Math.min((size.width - 2 * MARGIN) / picture.width, (size.height - 2 * MARGIN) / picture.height);

  const view = {
    scale: 1,
    offset: [0, 0],
    isFitted: true,

    toWindow: (/** @type {Point} */ [x, y]) => [
      view.offset[0] + (x + 0.5) * view.scale,
      view.offset[1] + (y + 0.5) * view.scale,
    ],
    toPicture: (/** @type {Point} */ [x, y]) => [
      (x - view.offset[0]) / view.scale - 0.5,
      (y - view.offset[1]) / view.scale - 0.5,
    ],

    /** Shows the whole picture, centred in the window. */
    fit() {
      if (!picture.width || !size.width || !size.height) return;
      view.scale = fitScale();
      view.offset = [(size.width - picture.width * view.scale) / 2, (size.height - picture.height * view.scale) / 2];
      view.isFitted = true;
    },

    /** Zooms by a factor about a point of the window, which keeps showing the same point of the picture. */
    zoomAbout(/** @type {Point} */ [x, y], /** @type {number} */ factor) {
      const smallest = Math.min(fitScale() / 3, 1);
      const scale = clamp(view.scale * factor, smallest, LARGEST_SCALE);
      const share = scale / view.scale;
      view.offset = [x - (x - view.offset[0]) * share, y - (y - view.offset[1]) * share];
      view.scale = scale;
      view.isFitted = false;
    },

    /** Shifts the picture; a strip of it always stays in the window. */
    panBy(/** @type {number} */ dx, /** @type {number} */ dy) {
      const keep = 32;
      view.offset = [
        clamp(view.offset[0] + dx, keep - picture.width * view.scale, size.width - keep),
        clamp(view.offset[1] + dy, keep - picture.height * view.scale, size.height - keep),
      ];
      view.isFitted = false;
    },
  };
  return view;
}
