/**
 * The line of messages at the bottom of the page, which is always there, so that nothing moves when one comes: on the
 * left what the mode says, on the right short messages. A longer one is cut; a click shows it whole.
 */

import { button, elementById, h, iconButton } from "./dom.js";
import { isAborted, isStale, messageOf } from "./errors.js";

/** Puts what a mode says of its state on the left, in place of what was there. */
export const showHints = (/** @type {Node[]} */ ...nodes) => elementById("hint").replaceChildren(...nodes);

const SHOWN_MS = { info: 4000, good: 4000, warn: 8000, error: 12000 };

/**
 * toast("Saved") · toast(error) · toast("text", "warn"): kinds are info, good, warn (also for a stale change) and error.
 * An error stays for twelve seconds, or until it is closed.
 *
 * @param {unknown} message an error, or a text.
 * @param {keyof typeof SHOWN_MS} [kind]
 */
export function toast(message, kind) {
  if (isAborted(message)) return;
  const isError = message instanceof Error;
  const shown = kind ?? (isStale(message) ? "warn" : isError ? "error" : "info");
  const text = messageOf(message);
  const host = elementById("toasts");
  for (const old of host.children) if (old.getAttribute("data-text") === text) old.remove();
  const note = h("div", {
    class: `toast ${shown}`,
    "data-testid": `toast-${shown}`,
    "data-text": text,
    role: shown === "error" ? "alert" : null,
  });
  const whole = button(text, () => note.classList.toggle("whole"), { class: "quiet text", title: text });
  note.append(
    whole,
    iconButton("close", "Close this message", () => note.remove()),
  );
  host.append(note);
  while (host.children.length > 5) host.firstElementChild?.remove();
  const end = () => (note.classList.contains("whole") ? setTimeout(end, SHOWN_MS.info) : note.remove());
  setTimeout(end, SHOWN_MS[shown]);
}
