/** The hint: what to do next, in one line. */

import { progressOf } from "./items.js";

const SIDES = ["front", "side"];

/**
 * @param {{draft: Draft | null, step: number, isReadonly: boolean, label: string, hasItems: boolean, guesses: number,
 *     notSaved: number}} situation
 */
export function hintFor({ draft, step, isReadonly, label, hasItems, guesses, notSaved }) {
  if (isReadonly) return "This frame is finalised. Reopen it to change something.";
  if (notSaved) return "Click the dashed box marked 'yours, not saved' to save it.";
  if (!draft && guesses) return "Press Enter to accept a dashed box, drag to correct it, or draw your own box.";
  if (!draft)
    return hasItems
      ? `Draw a box around the next ${label}, or press N for the next frame.`
      : `Draw a box around a ${label}.`;
  const name = draft.item.image_box.label;
  if (draft.item.uid && draft.item.boxes.every(Boolean))
    return `The ${name} is finished. Draw a box around the next one, or press N for the next frame.`;
  if (draft.stop) return "Change its box on the image, or delete it.";
  if (!draft.steps[step]) return `Drawing the views of the ${name} …`;
  const missing = [2 * step, 2 * step + 1].filter((index) => !draft.item.boxes[index]);
  if (!missing.length) return "";
  const where = missing.map((index) => SIDES[index % 2]).join(" and the ");
  const suggested = missing.some((index) => draft.suggestions[index]) ? " Press Enter to accept a dashed box." : "";
  return `${progressOf(draft.item)} of 5: draw a box around the ${name} on the ${where} view.${suggested}`;
}

/**
 * The text shown in place of the views; null if there are views.
 *
 * @param {Draft | null} draft
 * @param {number} step
 */
export function viewsMessage(draft, step) {
  if (!draft) return "An object's front and side view appear here once you have drawn its box on the image.";
  if (draft.steps[step]) return null;
  if (draft.stop) return draft.stop;
  return draft.isLoading ? "Drawing the views …" : null;
}
