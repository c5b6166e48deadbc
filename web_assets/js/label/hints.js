/** The hint: what to do next, in one line. */

import { filledBoxes } from "./draft.js";
import { progressOf } from "./items.js";

const SIDES = ["front", "side"];

/**
 * @param {{draft: Draft | null, isReadonly: boolean, label: string, hasItems: boolean, guesses: number,
 *     notSaved: number, isWholeOffered: boolean}} situation
 */
export function hintFor({ draft, isReadonly, label, hasItems, guesses, notSaved, isWholeOffered }) {
  if (isReadonly) return "This frame is finalised. Reopen it to change something.";
  if (notSaved) return "Click the dashed box marked 'yours, not saved' to save it.";
  if (!draft && guesses) return "Press Enter to accept a dashed box, drag to correct it, or draw your own box.";
  if (!draft)
    return hasItems
      ? `Draw a box around the next ${label}, or press N for the next frame.`
      : `Draw a box around a ${label}.`;
  const name = draft.item.image_box.label;
  if (isWholeOffered) {
    const others = (draft.whole?.boxes.length ?? 0) > 1 ? ", W shows another one" : "";
    return `The ${name} is finished. Enter confirms the dashed box as the whole ${name}${others}.`;
  }
  if (draft.item.uid && draft.item.boxes.every(Boolean))
    return `The ${name} is finished. Draw a box around the next one, or press N for the next frame.`;
  if (draft.stop) return "Change its box on the image, or delete it. In Review, C copies the previous frame's boxes.";
  if (draft.isLoading) return `Looking for the ${name} …`;
  if (!draft.steps.length) return "";
  if (hasSuggestions(draft)) return "Enter accepts the dashed boxes. Or drag an edge.";
  const step = draft.item.boxes[0] && draft.item.boxes[1] ? 1 : 0;
  const missing = [2 * step, 2 * step + 1].filter((index) => !draft.item.boxes[index]);
  if (!missing.length) return "";
  const where = missing.map((index) => SIDES[index % 2]).join(" and the ");
  return `${progressOf(draft.item)} of 5: draw a box around the ${name} on the ${where} view.`;
}

/**
 * True if Enter would finish an object: each of its views has a box, and some of these are suggested.
 *
 * @param {Draft} draft
 */
function hasSuggestions(draft) {
  return draft.suggestions.some(Boolean) && filledBoxes(draft).every(Boolean);
}

/**
 * The text shown in place of a step's views; null if there are views.
 *
 * @param {Draft | null} draft
 * @param {number} step
 */
export function viewsMessage(draft, step) {
  if (draft?.steps[step]) return null;
  if (step === 1) {
    if (!draft?.steps.length) return "";
    return draft.stop ?? "Two more views appear here once both boxes above are drawn.";
  }
  if (!draft) return "An object's views appear here once you have drawn its box on the image.";
  return draft.stop ?? (draft.isLoading ? "Looking for the object …" : "");
}

/**
 * Which detector suggests the boxes, or why none are suggested.
 *
 * @param {Draft | null} draft
 */
export function sourceOf(draft) {
  if (!draft?.steps.length || draft.isLoading || draft.item.boxes.every(Boolean)) return "";
  if (draft.detector === "loading") return "The detector is being loaded …";
  if (!draft.measuredBy) return "";
  return draft.note ? `No dashed boxes (${draft.measuredBy}): ${draft.note}` : `Dashed boxes: ${draft.measuredBy}`;
}
