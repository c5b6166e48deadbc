/** The object that is being drawn: its item, the views that the server draws for it, and suggestions on them. */

import { plainBox } from "./items.js";

/** Before the server has answered. @type {Pick<Api.StepsOut, keyof Draft["answer"]>} */
const NOTHING = {
  steps: [],
  outline: null,
  stop: null,
  detector: "none",
  measured_by: null,
  suggestion: null,
  problem: null,
  note: null,
};

/** @returns {Draft} */
export const makeDraft = (/** @type {Item} */ item, /** @type {number} */ frame) => ({
  item,
  frame,
  answer: NOTHING,
  isLoading: false,
  changes: 0,
  whole: null,
});

/** An object as the server needs it to draw its views; each box with the plane of the view that it was drawn on. */
export function drawnObject(/** @type {Item} */ { image_box, boxes, views }, /** @type {ViewBox[]} */ shown = boxes) {
  const planes = shown.map((box, index) => (box && views[index] && planeOf(views[index])) || null);
  return { image_box: plainBox(image_box), boxes: shown.map((box) => box && plainBox(box)), planes };
}

const planeOf = (/** @type {Api.ViewJson} */ { axes, metres_per_px, origin_m }) => ({ axes, metres_per_px, origin_m });

/** The suggested box on each view on which none is drawn. @returns {ViewBox[]} */
export const suggestionsOf = (/** @type {Draft} */ { item, answer }) => {
  const suggested = answer.steps.flatMap((step) => step.suggested);
  return item.boxes.map((box, index) => (box ? null : (suggested[index] ?? null)));
};

/** The drawn box on each view, or else the suggested one. @returns {ViewBox[]} */
export const filledBoxes = (/** @type {Draft} */ draft) =>
  suggestionsOf(draft).map((suggested, index) => draft.item.boxes[index] ?? suggested);

/**
 * Takes the server's views and suggestions, and the drawn boxes on these views. Where there is no view any more, a box
 * keeps the one that it was drawn on, until there is one again.
 */
export function takeSteps(/** @type {Draft} */ draft, /** @type {Api.StepsOut} */ answer) {
  const { item } = draft;
  const drawn = answer.steps.flatMap((step) => step.drawn);
  for (const [index, view] of answer.steps.flatMap(({ views }) => views).entries()) {
    item.views[index] = view;
    item.boxes[index] = drawn[index] && { ...plainBox(drawn[index]), label: item.image_box.label };
  }
  draft.answer = answer;
  draft.isLoading = false;
}

/** The reason why an object's views could not be loaded, in place of them. */
export function takeProblem(/** @type {Draft} */ draft, /** @type {string} */ stop) {
  draft.answer = { ...NOTHING, stop };
  draft.isLoading = false;
}
