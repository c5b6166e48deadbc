/** The objects of a frame as they are drawn: an image box with up to four boxes on its pseudo-views (`Item`). */

export const VIEWS = 4;
/** Drags that an object needs: the image box and four boxes on views. */
export const DRAGS = 1 + VIEWS;

/** @type {(keyof Rect)[]} */
const EDGES = ["x_min", "y_min", "x_max", "y_max"];

/** A copy with only the fields that are sent to the server; editors add others. */
export function plainBox(/** @type {Box2D} */ box) {
  const { label, x_min, y_min, x_max, y_max, score = 1 } = box;
  return { label, x_min, y_min, x_max, y_max, score };
}

/**
 * Gives a box the new name of its class.
 *
 * @param {Record<string, string>} renamed old name -> new name.
 * @returns {Naming}
 */
export function naming(renamed) {
  return (box) => (box && Object.hasOwn(renamed, box.label) ? { ...box, label: renamed[box.label] } : box);
}

/** Gives all boxes of an item the new names of their classes. */
export function relabelItem(/** @type {Item} */ item, /** @type {Naming} */ named) {
  item.image_box = named(item.image_box);
  item.stored = named(item.stored);
  item.boxes = item.boxes.map(named);
}

export function sameBox(/** @type {ViewBox | undefined} */ a, /** @type {ViewBox | undefined} */ b) {
  return (
    a === b || Boolean(a && b && a.label === b.label && EDGES.every((edge) => Math.abs(a[edge] - b[edge]) < 1e-6))
  );
}

/** The items of a frame's state, in the order of its image boxes. */
export function itemsOf(/** @type {FrameState} */ state) {
  return (state.image_boxes?.boxes ?? []).map((box) => {
    const object = state.objects.find((known) => sameBox(known.image_box, box));
    return { ...makeItem(plainBox(box), object?.views ?? [], object?.uid ?? null), stored: plainBox(box) };
  });
}

/**
 * @param {Box2D} imageBox
 * @param {[Api.ViewJson, ViewBox][]} [views] as the server stores them.
 * @param {string | null} [uid]
 * @returns {Item}
 */
export function makeItem(imageBox, views = [], uid = null) {
  /** @type {Item} */
  const item = {
    image_box: imageBox,
    uid,
    views: Array(VIEWS).fill(null),
    boxes: Array(VIEWS).fill(null),
    suggested: Array(VIEWS).fill(null),
    stored: null,
    found: null,
  };
  views.forEach(([view, box], index) => {
    const isAlone = index === views.length - 1 && index % 2 === 0;
    const place = isAlone && looksAside(view) ? index + 1 : index;
    item.views[place] = view;
    item.boxes[place] = box && plainBox(box);
  });
  return item;
}

/**
 * What a label records of the detector whose boxes the operator accepted; null if there are none.
 *
 * @returns {Api.Suggestion | null}
 */
export function suggestionOf(/** @type {Item} */ { suggested }) {
  const used = suggested.find(Boolean);
  return used ? { ...used, corrected: !suggested.every(Boolean) } : null;
}

/** True for the side view of a step, whose front view looks along the camera's axis rather than across it. */
const looksAside = (/** @type {Api.ViewJson} */ { axes }) => Math.abs(axes[0][2]) > Math.abs(axes[2][2]);

/** The number of an item's five drags that are done. */
export function progressOf(/** @type {Item} */ item) {
  return 1 + item.boxes.filter(Boolean).length;
}

/** The image boxes with `before` replaced by `after`: null for `before` appends, null for `after` removes. */
export function exchanged(
  /** @type {Box2D[]} */ boxes,
  /** @type {Box2D | null} */ before,
  /** @type {Box2D | null} */ after,
) {
  /** @type {Box2D[]} */
  const plain = boxes.map(plainBox);
  const index = before ? plain.findIndex((box) => sameBox(box, before)) : -1;
  if (index < 0) return after ? [...plain, after] : plain;
  return after ? plain.with(index, after) : plain.toSpliced(index, 1);
}

export const sameItem = (/** @type {Item} */ a, /** @type {Item} */ b) =>
  sameBox(a.image_box, b.image_box) && a.boxes.every((box, i) => sameBox(box, b.boxes[i]));

/** Intersection over union of two boxes of the same class; 0 for different classes. */
export function overlap(/** @type {Box2D} */ a, /** @type {Box2D} */ b) {
  if (a.label !== b.label) return 0;
  const width = Math.min(a.x_max, b.x_max) - Math.max(a.x_min, b.x_min);
  const height = Math.min(a.y_max, b.y_max) - Math.max(a.y_min, b.y_min);
  if (width <= 0 || height <= 0) return 0;
  const area = (/** @type {Rect} */ box) => (box.x_max - box.x_min) * (box.y_max - box.y_min);
  return (width * height) / (area(a) + area(b) - width * height);
}
