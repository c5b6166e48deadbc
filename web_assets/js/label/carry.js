/** Transfers a box from a pseudo-view to a new view of the same object, after its views were drawn again. */

/**
 * @param {Vector} a
 * @param {Vector} b
 */
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const NEAR = Math.cos((12 * Math.PI) / 180);
const SAME = 1 - 1e-9;

/**
 * The box on the new view that covers the same range in metres.
 *
 * @param {Box2D} box
 * @param {Api.ViewJson} from
 * @param {Api.ViewJson} to
 * @returns {{box: Box2D, isExact: boolean} | null} null if the directions of the views differ too much;
 *     exact if both have the same axes.
 */
export function carryBox(box, from, to) {
  const along = Math.min(dot(from.axes[0], to.axes[0]), dot(from.axes[1], to.axes[1]));
  if (along < NEAR) return null;
  const [left, right] = carrySpan([box.x_min, box.x_max], from, to, 0, to.width);
  const [top, bottom] = carrySpan([box.y_min, box.y_max], from, to, 1, to.height);
  if (right - left < 1 || bottom - top < 1) return null;
  return { box: { ...box, x_min: left, y_min: top, x_max: right, y_max: bottom }, isExact: along >= SAME };
}

/**
 * @param {number[]} span
 * @param {Plane} from
 * @param {Plane} to
 * @param {number} axis
 * @param {number} length
 */
function carrySpan(span, from, to, axis, length) {
  return span
    .map((px) => (from.origin_m[axis] + px * from.metres_per_px - to.origin_m[axis]) / to.metres_per_px)
    .map((px) => Math.min(Math.max(px, -0.5), length - 0.5));
}
