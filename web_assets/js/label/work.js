/** What Label mode works on: the open frame's objects, the current one, and what is offered. The other files share it. */

import { makeItem, overlap } from "./items.js";

const KIND_KEPT = "box-kind";
/** A box that the detector found is a drawn one already where they overlap by this much (IoU). */
const SAME_OBJECT = 0.4;

/**
 * work = {
 *   items,        the frame's objects (items.js)
 *   draft, step,  the current object (draft.js) or null, and which of its steps is shown
 *   label,        class of the next box
 *   selected,     the item that is selected on the image
 *   not_saved,    items that gave way to somebody else's version, kept in sight
 *   found,        what the image detector found
 *   frame_shown,  id
 *   loaded,       promise: the current object's views are on the screen
 *   coming,       whose views are on their way to the screen, or null
 *   point_size
 * }
 */
export function createWork(app) {
  return {
    items: [],
    draft: null,
    step: 0,
    label: app.state.project.classes[0],
    selected: null,
    not_saved: [],
    found: [],
    frame_shown: null,
    loaded: Promise.resolve(),
    coming: null,
    point_size: 1,
    get is_readonly() {
      return Boolean(app.state.frame?.frame.finalised);
    },
    /** What boxes measure: the frame's kind, or the one that was used last. */
    get kind() {
      return app.state.frame?.image_boxes?.box_kind ?? localStorage.getItem(KIND_KEPT) ?? "silhouette";
    },
  };
}

export function keepKind(kind) {
  localStorage.setItem(KIND_KEPT, kind);
}

/** Dashed boxes on the image: what was drawn here and not saved, and what the detector found where nothing is drawn. */
export function openGuesses({ is_readonly, items, not_saved, found }) {
  if (is_readonly) return [];
  const mine = not_saved.map((item) => ({ item, image_box: item.image_box, caption: "yours, not saved" }));
  const theirs = found.filter((box) => !items.some((item) => overlap(item.image_box, box) > SAME_OBJECT));
  return [...mine, ...theirs.map((box) => ({ item: makeItem(box), image_box: box, caption: `${box.label} ${Math.round(100 * box.score)} %` }))];
}
