/** The changes of a frame as saver.js wants them. */

import { exchanged, makeItem, plainBox } from "./items.js";

/** An object as it is now. Its `stored` image box becomes this one: later changes are on top of it. */
export function objectChange(item, { after, outline, kind }) {
  const image_box = plainBox(item.image_box);
  const before = item.stored;
  item.stored = image_box;
  const boxes = item.boxes.map((box) => box && plainBox(box));
  while (boxes.length && !boxes.at(-1)) boxes.pop();
  return {
    path: ["label", "object"],
    after,
    item: { ...makeItem(image_box), boxes: item.boxes.slice(), views: item.views.slice() },
    body: (state) => ({
      image_boxes: exchanged(state.image_boxes?.boxes ?? [], before, image_box),
      box_kind: kind(),
      object: { image_box, boxes, uid: state.labels.some(({ uid }) => uid === item.uid) ? item.uid : null },
    }),
    done: ({ uid }) => (item.uid = uid ?? item.uid),
    mine: () => ({ text: [`${image_box.label}: its box on the image and ${boxes.filter(Boolean).length} on the views`], boxes: [image_box], outlines: outline ? [outline] : [] }),
  };
}

/** An object that goes, with its label. */
export function removal(item, kind) {
  const { image_box } = item;
  return {
    path: ["changes"],
    // the uid and the stored box may come with a change that is sent before this one
    body: (state) => ({
      subject: item.uid,
      changes: [
        ...(state.labels.some(({ uid }) => uid === item.uid) ? [{ kind: "delete", uid: item.uid }] : []),
        { kind: "image_boxes", boxes: exchanged(state.image_boxes?.boxes ?? [], item.stored, null), box_kind: kind() },
      ],
    }),
    mine: () => ({ text: [`Deletes the ${image_box.label} in this place`], boxes: [image_box], outlines: [] }),
  };
}

/** All boxes of the frame measure something else. */
export function kindChange(kind) {
  return {
    path: ["changes"],
    body: (state) => ({ subject: null, changes: [{ kind: "image_boxes", boxes: (state.image_boxes?.boxes ?? []).map(plainBox), box_kind: kind }] }),
    mine: () => ({ text: [`All boxes say: ${kind}`], boxes: [], outlines: [] }),
  };
}

/** Finalises the frame, or opens it again. */
export function finality(is_final) {
  return {
    path: ["changes"],
    body: () => ({ subject: null, changes: [{ kind: is_final ? "finalise" : "reopen" }] }),
    mine: () => ({ text: [is_final ? "Finalises the frame" : "Opens the frame again"], boxes: [], outlines: [] }),
  };
}
