/**
 * The object that is being drawn: its item, the views of its steps as the server draws them, and what is suggested on them.
 *
 * draft = {item, frame, steps: [{views: [View, View]}], suggestions: [Box2D | null] x 4, edits: [int] x 4, outline, points,
 * stop, is_loading, detector, problem}: `frame` is its frame's id, `edits` counts what the operator did on each view, `detector`
 * and `problem` say how far the view detector is.
 */

import { carryBox } from "./carry.js";
import { plainBox, sameBox, VIEWS } from "./items.js";

export function makeDraft(item, frame) {
  return {
    item,
    frame,
    steps: [],
    suggestions: Array(VIEWS).fill(null),
    edits: Array(VIEWS).fill(0),
    outline: null,
    points: null,
    stop: null,
    is_loading: false,
    detector: "none",
    problem: null,
  };
}

/** How many boxes the server needs to draw what comes next: those of whole steps. */
export function wholeSteps(boxes) {
  if (!boxes[0] || !boxes[1]) return [];
  return boxes[2] && boxes[3] ? boxes.map(plainBox) : boxes.slice(0, 2).map(plainBox);
}

/**
 * Asks what an object's boxes lead to; with `suggest` also the view detector, which takes its time.
 *
 * @param {() => string} kind what the boxes measure.
 */
export function createAsk(app, kind) {
  return ({ item, frame }, boxes, suggest, signal) =>
    app.api.post(app.path("frames", frame, "label", "steps"), { image_box: plainBox(item.image_box), boxes, box_kind: kind(), suggest }, { signal });
}

/**
 * `load(draft)` brings a draft's views up to date with its boxes; boxes of views that changed are carried over. It resolves to
 * false where a newer call for the same object came in between, or `stop(item)`.
 */
export function createStepLoader(ask) {
  /** item -> its request */
  const requests = new Map();

  async function load(draft) {
    const { item } = draft;
    requests.get(item)?.abort();
    const own = new AbortController();
    requests.set(item, own);
    draft.is_loading = true;
    try {
      // until the views are those of the boxes as they lie now
      for (let sent = null, next = wholeSteps(item.boxes); !isSame(sent, next); ) {
        sent = next;
        const answer = await ask(draft, sent, false, own.signal);
        if (own.signal.aborted) return false;
        next = wholeSteps(item.boxes.slice(0, takeSteps(draft, answer)));
      }
      return true;
    } catch (error) {
      if (error.name === "AbortError") return false;
      throw error;
    } finally {
      if (requests.get(item) === own) {
        draft.is_loading = false;
        requests.delete(item);
      }
    }
  }

  return { load, stop: (item) => requests.get(item)?.abort() };
}

function isSame(sent, next) {
  return sent?.length === next.length && next.every((box, i) => sameBox(box, sent[i]));
}

/**
 * Takes the server's views, as far as they follow from boxes that lie on their views: where those of the first step had to be
 * carried over, its answer to where they lay before has another second step.
 *
 * @returns {number} how many views were taken.
 */
function takeSteps(draft, answer) {
  const { item } = draft;
  let taken = 0;
  let is_carried = false;
  for (const [index, view] of answer.steps.flatMap(({ views }) => views).entries()) {
    if (is_carried && index % 2 === 0) break;
    const old = item.views[index];
    if (old && old.id !== view.id) {
      is_carried = true;
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
  draft.points = answer.points;
  draft.stop = answer.stop;
  draft.detector = answer.detector;
  draft.problem = answer.problem;
  return taken;
}

function carryOver(draft, index, old, view) {
  const { item } = draft;
  const box = item.boxes[index] ?? draft.suggestions[index];
  const moved = box && carryBox(box, old, view);
  // On other axes it is a guess, which the operator confirms.
  const is_kept = Boolean(item.boxes[index] && moved?.is_exact);
  item.boxes[index] = is_kept ? plainBox(moved.box) : null;
  draft.suggestions[index] = is_kept ? null : (moved?.box ?? null);
}

/** Without a whole first step, or with another one, there are no views for the second: its boxes wait as guesses. */
export function demoteSecondStep(draft) {
  const { item, suggestions } = draft;
  draft.steps = draft.steps.slice(0, 1);
  for (const index of [2, 3]) {
    if (item.boxes[index]) suggestions[index] = item.boxes[index];
    item.boxes[index] = null;
  }
}
