/** Shown in place of the picture of a frame that cannot be read: the server's message, and what to do. */

import { button, h } from "./dom.js";
import { messageOf } from "./errors.js";

/** Number of frames that one request for the list returns. */
const PAGE = 1000;

/**
 * @param {HTMLElement} host the element that contains the picture.
 * @param {{onRetry: () => void, onStep: (which: Direction) => void}} actions what the buttons do.
 */
export function createFrameProblem(host, { onRetry, onStep }) {
  const text = h("p", { class: "error-box" });
  const root = h(
    "div",
    { class: "frame-problem", role: "alert", hidden: true, "data-testid": "frame-problem" },
    h("h3", {}, "This frame cannot be shown"),
    text,
    h(
      "p",
      { class: "help" },
      "Its saved boxes are safe. Solve the problem and try again, or go on with another frame.",
    ),
    h(
      "div",
      { class: "row" },
      button("Try again", onRetry, { "data-testid": "frame-retry" }),
      button("Previous frame", () => onStep("previous"), { "data-testid": "frame-previous" }),
      button("Next frame", () => onStep("next"), { "data-testid": "frame-next" }),
    ),
  );
  host.append(root);
  return {
    show(/** @type {unknown} */ error) {
      text.textContent = messageOf(error);
      root.hidden = false;
    },
    hide: () => (root.hidden = true),
  };
}

/** The frame before or after one that cannot be read, in the same recording; null if there is none. */
export async function frameBeside(/** @type {App} */ app, /** @type {number} */ id, /** @type {Direction} */ which) {
  let before = null;
  for (let offset = 0, total = 1; offset < total; offset += PAGE) {
    const page = await app.api.get(`${app.path("frames")}?offset=${offset}&limit=${PAGE}`);
    total = page.total;
    for (const row of page.frames) {
      const [here, wanted] = which === "next" ? [before, row] : [row, before];
      if (here?.id === id) return wanted?.recording === here.recording ? wanted.id : null;
      before = row;
    }
  }
  return null;
}
