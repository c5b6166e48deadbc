/** Shown in place of the picture of a frame that cannot be read: the server's message, and what to do. */

import { button, h } from "./dom.js";
import { messageOf } from "./errors.js";

/**
 * @param {HTMLElement} host the element that contains the picture.
 * @param {{onRetry: () => void, onStep: (which: Direction) => void}} actions what the buttons do.
 */
export function createFrameProblem(host, { onRetry, onStep }) {
  const problem = h("p.error-box");
  const root = h("div.frame-problem", { role: "alert", hidden: true, "data-testid": "frame-problem" }, [
    h("h3", "This frame cannot be shown"),
    problem,
    h("p.help", "Its saved boxes are safe. Solve the problem and try again, or go on with another frame."),
    h("div.row", [
      button("Try again", onRetry, { "data-testid": "frame-retry" }),
      button("Previous frame", () => onStep("previous"), { "data-testid": "frame-previous" }),
      button("Next frame", () => onStep("next"), { "data-testid": "frame-next" }),
    ]),
  ]);
  host.append(root);
  return {
    show(/** @type {unknown} */ error) {
      problem.textContent = messageOf(error);
      root.hidden = false;
    },
    hide: () => (root.hidden = true),
  };
}

/** The frame before or after one that cannot be read, in the same recording; null if there is none. */
export async function frameBeside(/** @type {App} */ app, /** @type {number} */ id, /** @type {Direction} */ which) {
  const beside = await app.api.get(app.path("frames", id, "beside"));
  return beside[which];
}
