/** The object that is being drawn: its item, the views that the server draws for it, and suggestions on them. */

import { isAborted } from "../errors.js";
import { carryBox } from "./carry.js";
import { plainBox, sameBox, secondAxes, VIEWS } from "./items.js";

/**
 * @param {Item} item
 * @param {number} frame
 * @returns {Draft}
 */
export function makeDraft(item, frame) {
  return {
    item,
    frame,
    steps: [],
    suggestions: Array(VIEWS).fill(null),
    kept: Array(VIEWS).fill(false),
    outline: null,
    stop: null,
    isLoading: false,
    changes: 0,
    detector: "none",
    measuredBy: null,
    suggestion: null,
    problem: null,
    note: null,
    whole: null,
  };
}

/**
 * An object as the server needs it to draw its views. Once a box is drawn on the second step, its views keep their
 * axes.
 *
 * @param {Draft} draft
 */
export function drawnObject({ item, kept }) {
  const boxes = item.boxes.map((box) => box && plainBox(box));
  while (boxes.length && !boxes.at(-1)) boxes.pop();
  const isDrawn = [2, 3].some((index) => item.boxes[index] || kept[index]);
  return { image_box: plainBox(item.image_box), boxes, axes: isDrawn ? secondAxes(item) : null };
}

/**
 * The drawn box on each view, or else the suggested one.
 *
 * @param {Draft} draft
 * @returns {ViewBox[]}
 */
export const filledBoxes = ({ item, suggestions }) => item.boxes.map((box, index) => box ?? suggestions[index]);

/**
 * Requests the views that follow from an object's boxes; with `suggest`, the server also suggests boxes on them.
 *
 * @param {App} app
 * @param {() => Api.BoxKind} kind what the boxes enclose.
 * @returns {AskSteps}
 */
export function createAsk(app, kind) {
  return (draft, suggest, signal) =>
    app.api.post(
      app.path("frames", draft.frame, "label", "steps"),
      { ...drawnObject(draft), box_kind: kind(), suggest },
      { signal },
    );
}

/**
 * `load(draft, suggest)` loads the views that follow from a draft's boxes, and transfers the boxes of views that have
 * changed. It resolves to false if a newer call for the same object has replaced it, or `stop(item)` has cancelled it.
 *
 * @param {AskSteps} ask
 */
export function createStepLoader(ask) {
  /**
   * Item -> its request.
   *
   * @type {Map<Item, AbortController>}
   */
  const requests = new Map();

  /**
   * @param {Draft} draft
   * @param {boolean} suggest
   */
  async function load(draft, suggest) {
    const { item } = draft;
    requests.get(item)?.abort();
    const own = new AbortController();
    requests.set(item, own);
    draft.isLoading = true;
    try {
      // repeated until the views match the present boxes
      /** @type {ViewBox[] | null} */
      let sent = null;
      while (!isSame(sent, item.boxes)) {
        sent = item.boxes.slice();
        const answer = await ask(draft, suggest, own.signal);
        if (own.signal.aborted) return false;
        takeSteps(draft, answer);
      }
      return true;
    } catch (error) {
      if (isAborted(error)) return false;
      throw error;
    } finally {
      if (requests.get(item) === own) {
        draft.isLoading = false;
        requests.delete(item);
      }
    }
  }

  /** @param {Item} item */
  const stop = (item) => requests.get(item)?.abort();

  return { load, stop };
}

/**
 * @param {ViewBox[] | null} sent
 * @param {ViewBox[]} now
 */
function isSame(sent, now) {
  return sent?.every((box, i) => sameBox(box, now[i]) || (!box && !now[i])) ?? false;
}

/**
 * Takes the server's views and suggestions. If boxes of the first step had to be transferred, the answer's second step
 * followed from their old positions and is ignored.
 *
 * @param {Draft} draft
 * @param {Api.StepsOut} answer
 */
export function takeSteps(draft, answer) {
  const { item } = draft;
  const suggested = answer.steps.flatMap((step) => step.suggested);
  let taken = 0;
  let isCarried = false;
  for (const [index, view] of answer.steps.flatMap(({ views }) => views).entries()) {
    if (isCarried && index % 2 === 0) break;
    const old = item.views[index];
    if (old && old.id !== view.id && (item.boxes[index] || draft.kept[index])) {
      isCarried = true;
      carryOver(draft, index, old, view);
    }
    item.views[index] = view;
    if (!draft.kept[index]) draft.suggestions[index] = item.boxes[index] ? null : suggested[index];
    taken = index + 1;
  }
  for (let index = taken; index < VIEWS; index++) if (!draft.kept[index]) draft.suggestions[index] = null;
  if (taken <= 2 && (!item.boxes[0] || !item.boxes[1])) demoteSecondStep(draft);
  draft.steps = answer.steps.slice(0, taken / 2);
  draft.outline = answer.outline;
  draft.stop = answer.stop;
  draft.detector = answer.detector;
  draft.measuredBy = answer.measured_by;
  draft.suggestion = answer.suggestion;
  draft.problem = answer.problem;
  draft.note = answer.note;
}

/**
 * @param {Draft} draft
 * @param {number} index
 * @param {Api.ViewJson} old
 * @param {Api.ViewJson} view
 */
function carryOver(draft, index, old, view) {
  const { item } = draft;
  const box = item.boxes[index] ?? draft.suggestions[index];
  const moved = box && carryBox(box, old, view);
  // on a view with other axes, the box is a guess that the operator must confirm
  const isExact = Boolean(item.boxes[index] && moved?.isExact);
  item.boxes[index] = moved && isExact ? plainBox(moved.box) : null;
  draft.kept[index] = Boolean(moved && !isExact);
  draft.suggestions[index] = isExact ? null : (moved?.box ?? null);
}

/**
 * Without the boxes of the first step, the second step has no views: its boxes become guesses.
 *
 * @param {Draft} draft
 */
export function demoteSecondStep(draft) {
  const { item, suggestions, kept } = draft;
  draft.steps = draft.steps.slice(0, 1);
  for (const index of [2, 3]) {
    if (!item.boxes[index]) continue;
    suggestions[index] = item.boxes[index];
    kept[index] = true;
    item.boxes[index] = null;
  }
}
