/**
 * The object that is being drawn: its item, the views of its steps as the server draws them, and what is suggested on them.
 *
 * draft = {item, steps: [{views: [View, View]}], suggestions: [Box2D | null] x 4, edits: [int] x 4, outline, points, stop,
 * is_loading, detector, problem}: `edits` counts what the operator did on each view, `detector` and `problem` say how far the
 * view detector is.
 */

import { carryBox } from "./carry.js";
import { plainBox, VIEWS } from "./items.js";

export function makeDraft(item) {
  return {
    item,
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
  return ({ item }, boxes, suggest, signal) =>
    app.api.post(app.path("frames", app.state.frame.frame.id, "label", "steps"), { image_box: plainBox(item.image_box), boxes, box_kind: kind(), suggest }, { signal });
}

/**
 * `load(draft)` brings a draft's views up to date with its boxes; boxes of views that changed are carried over. It resolves to
 * false where a newer call came in between.
 */
export function createStepLoader(ask) {
  let request = null;

  async function load(draft) {
    request?.abort();
    const own = (request = new AbortController());
    draft.is_loading = true;
    try {
      // A changed first step changes the second one's views, so two rounds settle everything.
      for (let round = 0; round < VIEWS; round++) {
        const sent = wholeSteps(draft.item.boxes);
        const answer = await ask(draft, sent, false, own.signal);
        if (!takeSteps(draft, answer) || sent.length === wholeSteps(draft.item.boxes).length) break;
      }
      return true;
    } catch (error) {
      if (error.name === "AbortError") return false;
      throw error;
    } finally {
      if (request === own) {
        draft.is_loading = false;
        request = null;
      }
    }
  }

  return { load, stop: () => request?.abort() };
}

/** Takes the server's views; true where boxes had to be carried over. */
function takeSteps(draft, answer) {
  const { item } = draft;
  let carried = false;
  answer.steps.forEach(({ views }, step) => {
    views.forEach((view, side) => {
      const index = 2 * step + side;
      const old = item.views[index];
      if (old && old.id !== view.id) {
        carried = true;
        carryOver(draft, index, old, view);
      }
      item.views[index] = view;
      if (item.loose?.[0].id === view.id) {
        item.boxes[index] ??= item.loose[1] && plainBox(item.loose[1]);
        item.loose = null;
      }
    });
  });
  if (!item.boxes[0] || !item.boxes[1]) demoteSecondStep(draft);
  draft.steps = answer.steps;
  draft.outline = answer.outline;
  draft.points = answer.points;
  draft.stop = answer.stop;
  draft.detector = answer.detector;
  draft.problem = answer.problem;
  return carried;
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

/** Without a whole first step there are no views for the second one: its boxes wait as guesses. */
export function demoteSecondStep({ item, suggestions }) {
  for (const index of [2, 3]) {
    if (item.boxes[index]) suggestions[index] = item.boxes[index];
    item.boxes[index] = null;
  }
}
