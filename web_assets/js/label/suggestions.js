/** The detectors' suggestions: problems with them, waiting for a detector that is being loaded, boxes on the image. */

import { takeSteps } from "./draft.js";

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
   * While the detector is being loaded, asks again for the suggestions of a draft. Any change of the draft, another
   * call, or `stop` ends that.
   *
   * @param {Draft} draft
   */
  async function follow(draft) {
    stop();
    report("view", draft.problem);
    const own = new AbortController();
    request = own;
    const { signal } = own;
    const { changes } = draft;
    try {
      while (draft.detector === "loading") {
        await new Promise((resolve) => setTimeout(resolve, LOADING_WAIT_MS));
        if (signal.aborted || draft.changes !== changes) return;
        const answer = await ask(draft, true, signal);
        if (signal.aborted || draft.changes !== changes) return;
        takeSteps(draft, answer);
        report("view", answer.problem);
        onSuggested(draft);
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

  return { follow, onImage, stop };
}
