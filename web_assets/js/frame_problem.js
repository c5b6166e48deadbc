/** What stands in the place of a picture where a frame cannot be read: the server's message, and what to do. */

import { h } from "./dom.js";

/** So many frames of the list are asked for at once. */
const PAGE = 1000;

/**
 * @param {HTMLElement} host the panel's place for the picture.
 * @param {{onRetry: () => void, onStep: (which: "previous" | "next") => void}} what the buttons do.
 */
export function createFrameProblem(host, { onRetry, onStep }) {
  const text = h("p", { class: "error-box" });
  const button = (label, onclick, testid) => h("button", { type: "button", onclick, "data-testid": testid }, label);
  const root = h(
    "div",
    { class: "frame-problem", role: "alert", hidden: true, "data-testid": "frame-problem" },
    h("h3", {}, "This frame cannot be shown"),
    text,
    h("p", { class: "help" }, "What is saved of it is safe. Put right what the message says and try again, or go on with another frame."),
    h("div", { class: "row" }, button("Try again", onRetry, "frame-retry"), button("Previous frame", () => onStep("previous"), "frame-previous"), button("Next frame", () => onStep("next"), "frame-next")),
  );
  host.append(root);
  return {
    show(error) {
      text.textContent = error.message;
      root.hidden = false;
    },
    hide: () => (root.hidden = true),
  };
}

/** The frame before or after one that nobody can read, in its recording; null where there is none. */
export async function frameBeside(app, id, which) {
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
