/**
 * What the detectors suggest, as dashed boxes. It comes after the views, which nobody shall wait for: it is taken only where
 * the operator has drawn nothing meanwhile, on the very views that were asked about.
 */

import { wholeSteps } from "./draft.js";

const LOADING_WAIT_MS = 1500;
/** Problems that were told; nobody is told twice, whatever pages are opened in between. */
const told = new Set();

/**
 * @param {(draft: object, boxes: object[], suggest: boolean, signal: AbortSignal) => Promise<object>} ask the steps' route.
 * @param {(draft: object) => void} onFound a draft got suggestions.
 */
export function createSuggester(app, { ask, onFound }) {
  let request = null;

  function tell(role, problem) {
    const key = `${app.state.route.project}: ${problem}`;
    if (!problem || told.has(key)) return;
    told.add(key);
    app.toast(`No suggestions: the ${role} detector cannot be loaded. ${problem}`, "warn");
  }

  function stop() {
    request?.abort();
    request = null;
  }

  /** Asks until the detector is loaded; ends with the next call, or `stop`. */
  async function suggest(draft) {
    stop();
    tell("view", draft.problem);
    const own = (request = new AbortController());
    const { signal } = own;
    try {
      while (!signal.aborted && (draft.detector === "loading" || draft.detector === "ready") && openViews(draft).length) {
        const before = openViews(draft);
        const answer = await ask(draft, wholeSteps(draft.item.boxes), true, signal);
        if (signal.aborted) return;
        draft.detector = answer.detector;
        tell("view", answer.problem);
        if (take(draft, before, answer)) onFound(draft);
        if (answer.detector !== "loading") return;
        await new Promise((resolve) => setTimeout(resolve, LOADING_WAIT_MS));
      }
    } catch (error) {
      // Without suggestions the object is drawn all the same.
      if (error.name !== "AbortError") app.toast(error);
    } finally {
      if (request === own) request = null;
    }
  }

  /** What the image detector finds on a frame. */
  async function onImage(frame) {
    const { boxes, problem } = await app.api.get(app.path("frames", frame, "label", "suggestions"));
    tell("image", problem);
    return boxes;
  }

  return { suggest, onImage, stop };
}

/** The views that a suggestion would help with, as they are now. */
function openViews({ item, steps, suggestions, edits }) {
  const views = steps.flatMap(({ views }) => views);
  const all = views.map(({ id }, index) => ({ index, id, label: item.image_box.label, edits: edits[index] }));
  return all.filter(({ index }) => !item.boxes[index] && !suggestions[index]);
}

/** Fills in what is still open and was open in the same way when it was asked for; true where something was. */
function take(draft, before, answer) {
  const now = openViews(draft);
  const asked = answer.steps.flatMap(({ views, suggested }) => views.map(({ id }, side) => ({ id, box: suggested[side] })));
  let is_filled = false;
  for (const { index, id, label, edits } of before) {
    const is_same = now.some((view) => view.index === index && view.id === id && view.label === label && view.edits === edits);
    if (!is_same || asked[index]?.id !== id || !asked[index].box) continue;
    draft.suggestions[index] = asked[index].box;
    is_filled = true;
  }
  return is_filled;
}
