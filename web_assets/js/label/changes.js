/** The changes of a frame, for saver.js. */

import { drawnObject } from "./draft.js";
import { exchanged, makeItem, plainBox, relabelItem, suggestionOf } from "./items.js";

/**
 * Saves an object as it is now. Afterwards `stored` is its image box, which later changes replace.
 *
 * @param {Draft} draft
 * @param {object} options
 * @param {Promise<unknown>} options.after
 * @param {() => Api.BoxKind} options.kind
 * @param {(drawn: Api.StepsOut) => void} options.onDrawn called with the views and suggestions that follow.
 * @returns {FrameChange}
 */
export function objectChange(draft, { after, kind, onDrawn }) {
  const { item, outline } = draft;
  const drawn = drawnObject(draft);
  const suggestion = suggestionOf(item);
  const kept = { ...makeItem(drawn.image_box), boxes: item.boxes.slice(), views: item.views.slice() };
  kept.stored = item.stored;
  item.stored = drawn.image_box;
  return {
    path: ["label", "object"],
    after,
    item: kept,
    relabel(named) {
      relabelItem(kept, named);
      drawn.image_box = named(drawn.image_box);
      drawn.boxes = drawn.boxes.map(named);
    },
    body: (state) => ({
      image_boxes: exchanged(state.image_boxes?.boxes ?? [], kept.stored, drawn.image_box),
      box_kind: kind(),
      object: { ...drawn, uid: state.labels.some(({ uid }) => uid === item.uid) ? item.uid : null, suggestion },
    }),
    done({ uid, drawn: following }) {
      item.uid = uid ?? item.uid;
      if (following) onDrawn(following);
    },
    mine: () => ({
      text: [`${drawn.image_box.label}: its box on the image and ${drawn.boxes.filter(Boolean).length} on the views`],
      boxes: [drawn.image_box],
      outlines: outline ? [outline] : [],
    }),
  };
}

/**
 * Deletes an object with its label.
 *
 * @returns {FrameChange}
 */
export function removal(/** @type {Item} */ item, /** @type {() => Api.BoxKind} */ kind) {
  const { image_box } = item;
  return {
    path: ["changes"],
    relabel: (named) => relabelItem(item, named),
    // made when it is sent: the answer to an earlier change may contain the uid and the stored box
    body: (state) => ({
      subject: item.uid,
      changes: [
        ...(state.labels.some(({ uid }) => uid === item.uid) ? [{ kind: "delete", uid: item.uid }] : []),
        { kind: "image_boxes", boxes: exchanged(state.image_boxes?.boxes ?? [], item.stored, null), box_kind: kind() },
      ],
    }),
    mine: () => ({ text: [`Deletes this ${image_box.label}`], boxes: [image_box], outlines: [] }),
  };
}

/**
 * Changes a label's 3D box; `kind`: what it encloses, null = as before.
 *
 * @param {Api.LabelJson} label
 * @param {Box3D} box
 * @param {{ kind: Api.BoxKind | null, item: Item, words: string, outline: Line[] }} more
 * @returns {FrameChange}
 */
export function boxChange({ uid, label, track_id }, box, { kind, item, words, outline }) {
  return {
    path: ["changes"],
    item,
    body: () => ({ subject: uid, changes: [{ kind: "edit", uid, label, box, track_id, box_kind: kind }] }),
    mine: () => ({ text: [`${label}: ${words}`], boxes: [], outlines: [outline] }),
  };
}

/**
 * Changes the kind of all boxes of the frame: what they enclose.
 *
 * @returns {FrameChange}
 */
export function kindChange(/** @type {Api.BoxKind} */ kind) {
  return {
    path: ["changes"],
    body: (state) => ({
      subject: null,
      changes: [{ kind: "image_boxes", boxes: (state.image_boxes?.boxes ?? []).map(plainBox), box_kind: kind }],
    }),
    mine: () => ({
      text: [kind === "box" ? "All boxes enclose the whole object" : "All boxes enclose the visible part"],
      boxes: [],
      outlines: [],
    }),
  };
}

/**
 * Sets values of attributes of a label, or (null) of the frame.
 *
 * @returns {FrameChange}
 */
export function valuesChange(
  /** @type {string | null} */ uid,
  /** @type {Record<string, string | number | boolean | null>} */ values,
) {
  return {
    path: ["attributes"],
    isSmall: true,
    body: () => ({ uid, values }),
    mine: () => ({ text: [`Sets ${Object.keys(values).join(", ")}`], boxes: [], outlines: [] }),
  };
}

/**
 * Finalises the frame, or reopens it.
 *
 * @returns {FrameChange}
 */
export function finality(/** @type {boolean} */ isFinal) {
  return {
    path: ["changes"],
    body: () => ({ subject: null, changes: [{ kind: isFinal ? "finalise" : "reopen" }] }),
    mine: () => ({ text: [isFinal ? "Finalises the frame" : "Reopens the frame"], boxes: [], outlines: [] }),
  };
}
