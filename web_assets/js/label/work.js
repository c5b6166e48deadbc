/** Label mode's state, which its files share: the open frame's objects, the current one, and suggestions. */

import { makeItem, naming, overlap, relabelItem } from "./items.js";

const KIND_KEPT = "box-kind";
/** IoU above which a detected box and a drawn one are the same object. */
const SAME_OBJECT = 0.4;

/** @returns {Work} */
export function createWork(/** @type {ModeApp} */ app) {
  return {
    items: [],
    draft: null,
    picked: app.state.project.classes[0],
    selected: null,
    notSaved: [],
    detections: [],
    frameShown: null,
    loaded: Promise.resolve(),
    coming: null,
    /** The class that was picked; the first one if that was removed. */
    get label() {
      const { classes } = app.state.project;
      return classes.includes(this.picked) ? this.picked : classes[0];
    },
    set label(name) {
      this.picked = name;
    },
    get isReadonly() {
      return Boolean(app.state.frame?.frame.finalised);
    },
    /** The frame's kind of boxes, or the one that was used last. */
    get kind() {
      const kept = localStorage.getItem(KIND_KEPT) === "box" ? "box" : "silhouette";
      return app.state.frame?.image_boxes?.box_kind ?? kept;
    },
  };
}

/**
 * Gives everything that is drawn the new names of its classes.
 *
 * @param {Work} work
 * @param {Record<string, string>} renamed old name -> new name.
 */
export function renameClasses(work, renamed) {
  const named = naming(renamed);
  if (Object.hasOwn(renamed, work.picked)) work.picked = renamed[work.picked];
  work.detections = work.detections.map(named);
  for (const item of new Set([...work.items, ...work.notSaved])) relabelItem(item, named);
  if (work.draft) work.draft.suggestions = work.draft.suggestions.map(named);
}

export function keepKind(/** @type {Api.BoxKind} */ kind) {
  localStorage.setItem(KIND_KEPT, kind);
}

/**
 * Dashed boxes on the image: this page's unsaved boxes, and detected ones at places where nothing is drawn.
 *
 * @returns {Guess[]}
 */
export function openGuesses(/** @type {Work} */ { isReadonly, items, notSaved, detections }) {
  if (isReadonly) return [];
  const unsaved = notSaved.map((item) => ({ item, image_box: item.image_box, caption: "yours, not saved" }));
  const suggested = detections.filter((box) => !items.some((item) => overlap(item.image_box, box) > SAME_OBJECT));
  return [
    ...unsaved,
    ...suggested.map((box) => ({
      item: makeItem(box),
      image_box: box,
      caption: `${box.label} ${Math.round(100 * (box.score ?? 1))} %`,
    })),
  ];
}
