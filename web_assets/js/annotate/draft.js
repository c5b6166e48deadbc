/** The object that is being drawn: its item, the views that the server draws for it, and suggestions on them. */

import { isAborted } from "../errors.js";
import { plainBox, sameBox, secondAxes, VIEWS } from "./items.js";

/** @returns {Draft} */
export function makeDraft(/** @type {Item} */ item, /** @type {number} */ frame) {
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
 */
export function drawnObject(/** @type {Draft} */ { item, kept }) {
  const boxes = item.boxes.map((box) => box && plainBox(box));
  while (boxes.length && !boxes.at(-1)) boxes.pop();
  const isDrawn = [2, 3].some((index) => item.boxes[index] || kept[index]);
  return { image_box: plainBox(item.image_box), boxes, axes: isDrawn ? secondAxes(item) : null };
}

/** The drawn box on each view, or else the suggested one. @returns {ViewBox[]} */
export const filledBoxes = (/** @type {Draft} */ { item, suggestions }) =>
  item.boxes.map((box, index) => box ?? suggestions[index]);

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
 */
export function createStepLoader(/** @type {AskSteps} */ ask) {
  /** Item -> its request. @type {Map<Item, AbortController>} */
  const requests = new Map();

  async function load(/** @type {Draft} */ draft, /** @type {boolean} */ suggest) {
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

  const stop = (/** @type {Item} */ item) => requests.get(item)?.abort();

  return { load, stop };
}

function isSame(/** @type {ViewBox[] | null} */ sent, /** @type {ViewBox[]} */ now) {
  return sent?.every((box, i) => sameBox(box, now[i]) || (!box && !now[i])) ?? false;
}

/**
 * Takes the server's views and suggestions. If boxes of the first step had to be transferred, the answer's second step
 * followed from their old positions and is ignored.
 */
export function takeSteps(/** @type {Draft} */ draft, /** @type {Api.StepsOut} */ answer) {
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

function carryOver(
  /** @type {Draft} */ draft,
  /** @type {number} */ index,
  /** @type {Api.ViewJson} */ old,
  /** @type {Api.ViewJson} */ view,
) {
  const { item } = draft;
  const box = item.boxes[index] ?? draft.suggestions[index];
  const moved = box && carryBox(box, old, view);
  // on a view with other axes, the box is a guess that the operator must confirm
  const isExact = Boolean(item.boxes[index] && moved?.isExact);
  item.boxes[index] = moved && isExact ? plainBox(moved.box) : null;
  draft.kept[index] = Boolean(moved && !isExact);
  draft.suggestions[index] = isExact ? null : (moved?.box ?? null);
}

/** Without the boxes of the first step, the second step has no views: its boxes become guesses. */
export function demoteSecondStep(/** @type {Draft} */ draft) {
  const { item, suggestions, kept } = draft;
  draft.steps = draft.steps.slice(0, 1);
  for (const index of [2, 3]) {
    if (!item.boxes[index]) continue;
    suggestions[index] = item.boxes[index];
    kept[index] = true;
    item.boxes[index] = null;
  }
}

// -- a box transferred to a new view of the same object, after its views were drawn again

const dot = (/** @type {Vector} */ a, /** @type {Vector} */ b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const NEAR = Math.cos((12 * Math.PI) / 180);
const SAME = 1 - 1e-9;

/**
 * The box on the new view that covers the same range in metres.
 *
 * @param {Box2D} box
 * @param {Api.ViewJson} from
 * @param {Api.ViewJson} to
 * @returns {{box: Box2D, isExact: boolean} | null} null if the directions of the views differ too much;
 *     exact if both have the same axes.
 */
export function carryBox(box, from, to) {
  const along = Math.min(dot(from.axes[0], to.axes[0]), dot(from.axes[1], to.axes[1]));
  if (along < NEAR) return null;
  const [left, right] = carrySpan([box.x_min, box.x_max], from, to, 0, to.width);
  const [top, bottom] = carrySpan([box.y_min, box.y_max], from, to, 1, to.height);
  if (right - left < 1 || bottom - top < 1) return null;
  return { box: { ...box, x_min: left, y_min: top, x_max: right, y_max: bottom }, isExact: along >= SAME };
}

function carrySpan(
  /** @type {number[]} */ span,
  /** @type {Plane} */ from,
  /** @type {Plane} */ to,
  /** @type {number} */ axis,
  /** @type {number} */ length,
) {
  return span
    .map((px) => (from.origin_m[axis] + px * from.metres_per_px - to.origin_m[axis]) / to.metres_per_px)
    .map((px) => Math.min(Math.max(px, -0.5), length - 0.5));
}

// -- objects whose image box was moved: their boxes on views are transferred to the new views before the object is
// saved; otherwise the server would take pixels of the old views for pixels of the new ones

/**
 * An object that was moved. `views` is the latest loading; null if the views must be loaded again.
 *
 * @typedef {{ draft: Draft, views: Promise<boolean> | null, isWaiting: boolean }} Move
 */

export function createMoves(/** @type {StepLoader} */ loader) {
  /**
   * Kept afterwards, because the drafts contain, as guesses, the boxes that could not be transferred.
   *
   * @type {WeakMap<Item, Move>}
   */
  const moves = new WeakMap();

  /** Loads a draft's views with the loader. */
  function load(/** @type {Draft} */ draft, /** @type {boolean} */ suggest) {
    const views = loader.load(draft, suggest);
    const move = moves.get(draft.item);
    if (move) move.views = views;
    return views;
  }

  return {
    load,
    /** True if an object's boxes have not been transferred to its new views yet. */
    isWaiting: (/** @type {Item} */ item) => Boolean(moves.get(item)?.isWaiting),
    /** The draft of an object that was moved. */
    draftOf: (/** @type {Item} */ item) => moves.get(item)?.draft ?? null,
    /** From now on, saving a draft's object waits for its views. */
    start: (/** @type {Draft} */ draft) => moves.set(draft.item, { draft, views: null, isWaiting: true }),

    /** Forgets a move: the object was removed, or another version of it was taken. */
    forget(/** @type {Item} */ item) {
      moves.delete(item);
      loader.stop(item);
    },

    /** Stops loading the views of a draft that is no longer the current one, unless its object was moved. */
    leave(/** @type {Draft | null} */ draft) {
      if (draft && !moves.get(draft.item)?.isWaiting) loader.stop(draft.item);
    },

    /**
     * Resolves to true once an object's boxes are on its own views, to false if it is gone. Rejects if its views
     * cannot be loaded; another call tries again.
     *
     * @param {Item} item
     * @param {(draft: Draft) => void} ask loads the views with `load`.
     */
    async settle(item, ask) {
      for (let move = moves.get(item); move?.isWaiting && move === moves.get(item); ) {
        if (!move.views) ask(move.draft);
        const { views } = move;
        try {
          const isNewest = await views;
          if (move.views !== views) continue;
          move.isWaiting = !isNewest;
          if (isNewest) return true;
          move.views = null;
        } catch (error) {
          if (move.views !== views) continue;
          move.views = null;
          if (move === moves.get(item)) throw error;
        }
      }
      return false;
    },
  };
}
