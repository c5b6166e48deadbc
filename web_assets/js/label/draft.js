/** The object that is being drawn: its item, the views that the server draws for it, and suggestions on them. */

import { isAborted } from "../errors.js";
import { carryBox } from "./carry.js";
import { plainBox, sameBox, VIEWS } from "./items.js";

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
    edits: Array(VIEWS).fill(0),
    outline: null,
    stop: null,
    isLoading: false,
    detector: "none",
    problem: null,
  };
}

/**
 * The boxes of complete steps: the server needs these to draw the next views.
 *
 * @param {ViewBox[]} boxes
 */
export function wholeSteps(boxes) {
  const [a, b, c, d] = boxes;
  if (!a || !b) return [];
  return c && d ? [a, b, c, d].map(plainBox) : [a, b].map(plainBox);
}

/**
 * Requests the views that follow from an object's boxes; with `suggest`, the server also runs the view detector.
 *
 * @param {App} app
 * @param {() => Api.BoxKind} kind what the boxes enclose.
 * @returns {AskSteps}
 */
export function createAsk(app, kind) {
  return ({ item, frame }, boxes, suggest, signal) =>
    app.api.post(
      app.path("frames", frame, "label", "steps"),
      { image_box: plainBox(item.image_box), boxes, box_kind: kind(), suggest },
      { signal },
    );
}

/**
 * `load(draft)` loads the views that follow from a draft's boxes, and transfers the boxes of views that have changed.
 * It resolves to false if a newer call for the same object has replaced it, or `stop(item)` has cancelled it.
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

  /** @param {Draft} draft */
  async function load(draft) {
    const { item } = draft;
    requests.get(item)?.abort();
    const own = new AbortController();
    requests.set(item, own);
    draft.isLoading = true;
    try {
      // repeated until the views match the present boxes
      /** @type {ViewBox[] | null} */
      let sent = null;
      let next = wholeSteps(item.boxes);
      while (!isSame(sent, next)) {
        sent = next;
        const answer = await ask(draft, sent, false, own.signal);
        if (own.signal.aborted) return false;
        next = wholeSteps(item.boxes.slice(0, takeSteps(draft, answer)));
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
 * @param {ViewBox[]} next
 */
function isSame(sent, next) {
  return sent !== null && sent.length === next.length && next.every((box, i) => sameBox(box, sent[i]));
}

/**
 * Takes the server's views. If boxes of the first step had to be transferred, the answer's second step followed from
 * their old positions and is ignored.
 *
 * @param {Draft} draft
 * @param {Api.StepsOut} answer
 * @returns {number} the number of views taken.
 */
function takeSteps(draft, answer) {
  const { item } = draft;
  let taken = 0;
  let isCarried = false;
  for (const [index, view] of answer.steps.flatMap(({ views }) => views).entries()) {
    if (isCarried && index % 2 === 0) break;
    const old = item.views[index];
    if (old && old.id !== view.id) {
      isCarried = true;
      carryOver(draft, index, old, view);
    }
    item.views[index] = view;
    if (item.loose?.[0].id === view.id) {
      item.boxes[index] ??= item.loose[1] && plainBox(item.loose[1]);
      item.loose = null;
    }
    taken = index + 1;
  }
  if (!item.boxes[0] || !item.boxes[1]) demoteSecondStep(draft);
  draft.steps = answer.steps.slice(0, taken / 2);
  draft.outline = answer.outline;
  draft.stop = answer.stop;
  draft.detector = answer.detector;
  draft.problem = answer.problem;
  return taken;
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
  const isKept = Boolean(item.boxes[index] && moved?.isExact);
  item.boxes[index] = moved && isKept ? plainBox(moved.box) : null;
  draft.suggestions[index] = isKept ? null : (moved?.box ?? null);
}

/**
 * Without the boxes of the first step, the second step has no views: its boxes become guesses.
 *
 * @param {Draft} draft
 */
export function demoteSecondStep(draft) {
  const { item, suggestions } = draft;
  draft.steps = draft.steps.slice(0, 1);
  for (const index of [2, 3]) {
    if (item.boxes[index]) suggestions[index] = item.boxes[index];
    item.boxes[index] = null;
  }
}
