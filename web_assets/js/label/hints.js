/** What to do next, in one line. */

import { progressOf } from "./items.js";

const SIDES = ["front", "side"];

export function hintFor({ draft, step, is_readonly, label, has_items, guesses, not_saved }) {
  if (is_readonly) return "This frame is finalised. Reopen it to change something.";
  if (not_saved) return "Click the dashed box that says 'yours' to save it after all.";
  if (!draft && guesses) return "Enter accepts a dashed box, a drag corrects it; or drag a box of your own.";
  if (!draft) return has_items ? `Drag a box around the next ${label}, or go on with N.` : `Drag a box around a ${label}.`;
  const name = draft.item.image_box.label;
  if (draft.item.uid && draft.item.boxes.every(Boolean)) return `The ${name} is finished. Drag a box around the next one, or go on with N.`;
  if (draft.stop) return "Change its box on the image, or delete it.";
  if (!draft.steps[step]) return `Drawing the views of the ${name} …`;
  const missing = [2 * step, 2 * step + 1].filter((index) => !draft.item.boxes[index]);
  if (!missing.length) return "";
  const where = missing.map((index) => SIDES[index % 2]).join(" and the ");
  const suggested = missing.some((index) => draft.suggestions[index]) ? " Enter accepts a dashed box." : "";
  return `${progressOf(draft.item)} of 5: box the ${name} on the ${where} view.${suggested}`;
}

/** What stands in place of the views; null where they are there. */
export function viewsMessage(draft, step) {
  if (!draft) return "The front and the side view of an object appear here as soon as its box on the image is drawn.";
  if (draft.steps[step]) return null;
  if (draft.stop) return draft.stop;
  return draft.is_loading ? "Drawing the views …" : null;
}
