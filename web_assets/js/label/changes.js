/** The changes of a frame, for saver.js. */

import { exchanged, makeItem, plainBox } from "./items.js";

/**
 * Saves an object as it is now. Afterwards `stored` is its image box, which later changes replace.
 *
 * @param {Item} item
 * @param {{ after: Promise<unknown>, outline: Line[] | null, kind: () => Api.BoxKind }} options
 * @returns {FrameChange}
 */
export function objectChange(item, { after, outline, kind }) {
  const box = plainBox(item.image_box);
  const before = item.stored;
  item.stored = box;
  const boxes = item.boxes.map((one) => one && plainBox(one));
  while (boxes.length && !boxes.at(-1)) boxes.pop();
  return {
    path: ["label", "object"],
    after,
    item: { ...makeItem(box), boxes: item.boxes.slice(), views: item.views.slice() },
    body: (state) => ({
      image_boxes: exchanged(state.image_boxes?.boxes ?? [], before, box),
      box_kind: kind(),
      object: { image_box: box, boxes, uid: state.labels.some(({ uid }) => uid === item.uid) ? item.uid : null },
    }),
    done({ uid }) {
      item.uid = uid ?? item.uid;
    },
    mine: () => ({
      text: [`${box.label}: its box on the image and ${boxes.filter(Boolean).length} on the views`],
      boxes: [box],
      outlines: outline ? [outline] : [],
    }),
  };
}

/**
 * Deletes an object with its label.
 *
 * @param {Item} item
 * @param {() => Api.BoxKind} kind
 * @returns {FrameChange}
 */
export function removal(item, kind) {
  const { image_box } = item;
  return {
    path: ["changes"],
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
 * Changes the kind of all boxes of the frame: what they enclose.
 *
 * @param {Api.BoxKind} kind
 * @returns {FrameChange}
 */
export function kindChange(kind) {
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
 * Finalises the frame, or reopens it.
 *
 * @param {boolean} isFinal
 * @returns {FrameChange}
 */
export function finality(isFinal) {
  return {
    path: ["changes"],
    body: () => ({ subject: null, changes: [{ kind: isFinal ? "finalise" : "reopen" }] }),
    mine: () => ({ text: [isFinal ? "Finalises the frame" : "Reopens the frame"], boxes: [], outlines: [] }),
  };
}
