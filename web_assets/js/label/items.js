/**
 * The objects of a frame as Label mode works on them: an image box with up to four boxes on its pseudo-views.
 *
 * An item is {image_box, boxes: [Box2D | null] x 4, uid, views: [View | null] x 4, stored}: front and side of step 1, then of
 * step 2. `stored` is the image box that the server was told last, null before the first time.
 */

export const VIEWS = 4;
/** Drags that an object needs: the image box and four boxes on views. */
export const DRAGS = 1 + VIEWS;

const EDGES = ["x_min", "y_min", "x_max", "y_max"];

/** The fields of a box that are sent; editors put more on it. */
export function plainBox(box) {
  const { label, x_min, y_min, x_max, y_max, score = 1 } = box;
  return { label, x_min, y_min, x_max, y_max, score };
}

export function sameBox(a, b) {
  return a === b || (a && b && a.label === b.label && EDGES.every((edge) => Math.abs(a[edge] - b[edge]) < 1e-6)) || false;
}

/** The items of a frame's state, in the order of its image boxes. */
export function itemsOf(state) {
  return (state.image_boxes?.boxes ?? []).map((image_box) => {
    const object = state.objects.find((known) => sameBox(known.image_box, image_box));
    return { ...makeItem(plainBox(image_box), object?.views ?? [], object?.uid ?? null), stored: plainBox(image_box) };
  });
}

/**
 * @param {[View, Box2D | null][]} views as the server keeps them. Of a step with one view alone nothing says which side it
 *     is: that one stays `loose` until the step's views are there (see draft.js).
 */
export function makeItem(image_box, views = [], uid = null) {
  const whole = views.slice(0, views.length - (views.length % 2));
  const padded = Array.from({ length: VIEWS }, (_, i) => whole[i] ?? [null, null]);
  const boxes = padded.map(([, box]) => box && plainBox(box));
  return { image_box, uid, views: padded.map(([view]) => view), boxes, loose: views[whole.length] ?? null, stored: null };
}

/** How many of its five drags an item has. */
export function progressOf(item) {
  return 1 + item.boxes.filter(Boolean).length + (item.loose?.[1] ? 1 : 0);
}

/** The first step (0 or 1) that still lacks a box; the last one where none does. */
export function openStep(item) {
  return item.boxes[0] && item.boxes[1] ? 1 : 0;
}

/** A list of image boxes in which one took the place of another: null for `before` appends, null for `after` removes. */
export function exchanged(boxes, before, after) {
  const plain = boxes.map(plainBox);
  const index = before ? plain.findIndex((box) => sameBox(box, before)) : -1;
  if (index < 0) return after ? [...plain, after] : plain;
  return after ? plain.with(index, after) : plain.toSpliced(index, 1);
}

export function sameItem(a, b) {
  return sameBox(a.image_box, b.image_box) && progressOf(a) === progressOf(b) && a.boxes.every((box, i) => sameBox(box, b.boxes[i]) || (!box && !b.boxes[i]));
}

/** Intersection over union of two boxes of the same class; 0 for different classes. */
export function overlap(a, b) {
  if (a.label !== b.label) return 0;
  const width = Math.min(a.x_max, b.x_max) - Math.max(a.x_min, b.x_min);
  const height = Math.min(a.y_max, b.y_max) - Math.max(a.y_min, b.y_min);
  if (width <= 0 || height <= 0) return 0;
  const area = (box) => (box.x_max - box.x_min) * (box.y_max - box.y_min);
  return (width * height) / (area(a) + area(b) - width * height);
}
