/**
 * The detectors' suggestions, shown as dashed boxes. They arrive after the views. A view uses them only if
 * it has not changed and the operator has not drawn on it in the meantime.
 */

import { wholeSteps } from "./draft.js";

const LOADING_WAIT_MS = 1500;
/**
 * Problems that have been shown; each is shown only once.
 *
 * @type {Set<string>}
 */
const reported = new Set();

/**
 * @param {ModeApp} app
 * @param {object} parts
 * @param {AskSteps} parts.ask
 * @param {(draft: Draft) => void} parts.onSuggested called when a draft has new suggestions.
 */
export function createSuggester(app, { ask, onSuggested }) {
  /** @type {AbortController | null} */
  let request = null;

  /**
   * @param {Api.DetectorKind} role
   * @param {string | null | undefined} problem
   */
  function report(role, problem) {
    const key = `${app.state.route.project}: ${problem}`;
    if (!problem || reported.has(key)) return;
    reported.add(key);
    app.toast(`No suggestions: the ${role} detector cannot be loaded. ${problem}`, "warn");
  }

  function stop() {
    request?.abort();
    request = null;
  }

  /**
   * Repeats the request until the detector is loaded; the next call, or `stop`, cancels it.
   *
   * @param {Draft} draft
   */
  async function suggest(draft) {
    stop();
    report("view", draft.problem);
    const own = new AbortController();
    request = own;
    const { signal } = own;
    try {
      while (
        !signal.aborted &&
        (draft.detector === "loading" || draft.detector === "ready") &&
        openViews(draft).length
      ) {
        const before = openViews(draft);
        const answer = await ask(draft, wholeSteps(draft.item.boxes), true, signal);
        if (signal.aborted) return;
        draft.detector = answer.detector;
        report("view", answer.problem);
        if (take(draft, before, answer)) onSuggested(draft);
        if (answer.detector !== "loading") return;
        await new Promise((resolve) => setTimeout(resolve, LOADING_WAIT_MS));
      }
    } catch (error) {
      // the object can be drawn without suggestions
      app.toast(error);
    } finally {
      if (request === own) request = null;
    }
  }

  /**
   * The boxes that the image detector finds on a frame.
   *
   * @param {number} frame
   */
  async function onImage(frame) {
    /** @type {Api.SuggestionsOut} */
    const { boxes, problem } = await app.api.get(app.path("frames", frame, "label", "suggestions"));
    report("image", problem);
    return boxes;
  }

  return { suggest, onImage, stop };
}

/**
 * The views without a box or suggestion, as they are now.
 *
 * @param {Draft} draft
 */
function openViews({ item, steps, suggestions, edits }) {
  const views = steps.flatMap(({ views }) => views);
  const all = views.map(({ id }, index) => ({ index, id, label: item.image_box.label, edits: edits[index] }));
  return all.filter(({ index }) => !item.boxes[index] && !suggestions[index]);
}

/**
 * Takes suggestions for views that have not changed since the request; true if there was one.
 *
 * @param {Draft} draft
 * @param {ReturnType<typeof openViews>} before
 * @param {Api.StepsOut} answer
 */
function take(draft, before, answer) {
  const now = openViews(draft);
  const asked = answer.steps.flatMap(({ views, suggested }) =>
    views.map(({ id }, side) => ({ id, box: suggested[side] })),
  );
  let isFilled = false;
  for (const { index, id, label, edits } of before) {
    const isSame = now.some(
      (view) => view.index === index && view.id === id && view.label === label && view.edits === edits,
    );
    if (!isSame || asked[index]?.id !== id || !asked[index].box) continue;
    draft.suggestions[index] = asked[index].box;
    isFilled = true;
  }
  return isFilled;
}
