/** A box taken from one pseudo-view to another one of the same object, when its views were drawn anew. */

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const NEAR = Math.cos((12 * Math.PI) / 180);
const SAME = 1 - 1e-9;

/**
 * The box on the new view that spans the same metres.
 *
 * @returns {{box: object, is_exact: boolean} | null} null where the views look along too different directions; exact where
 *     both have the same axes.
 */
export function carryBox(box, from, to) {
  const along = Math.min(dot(from.axes[0], to.axes[0]), dot(from.axes[1], to.axes[1]));
  if (along < NEAR) return null;
  const [x_min, x_max] = carrySpan([box.x_min, box.x_max], from, to, 0, to.width);
  const [y_min, y_max] = carrySpan([box.y_min, box.y_max], from, to, 1, to.height);
  if (x_max - x_min < 1 || y_max - y_min < 1) return null;
  return { box: { ...box, x_min, y_min, x_max, y_max }, is_exact: along >= SAME };
}

function carrySpan(span, from, to, axis, length) {
  return span
    .map((px) => (from.origin_m[axis] + px * from.metres_per_px - to.origin_m[axis]) / to.metres_per_px)
    .map((px) => Math.min(Math.max(px, -0.5), length - 0.5));
}
