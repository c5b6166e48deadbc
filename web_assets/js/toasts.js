/** Short messages in the corner. An error stays for twelve seconds, or until it is closed. */

import { elementById, h, iconButton } from "./dom.js";
import { isAborted, messageOf } from "./errors.js";

const SHOWN_MS = { info: 4000, good: 4000, warn: 8000, error: 12000 };

/**
 * toast("Saved") · toast(error) · toast("text", "warn"): kinds are info, good, warn and error.
 *
 * @param {unknown} message an error, or a text.
 * @param {keyof typeof SHOWN_MS} [kind]
 */
export function toast(message, kind) {
  if (isAborted(message)) return;
  const isError = message instanceof Error;
  const shown = kind ?? (isError ? "error" : "info");
  const text = messageOf(message);
  const host = elementById("toasts");
  for (const old of host.children) if (old.getAttribute("data-text") === text) old.remove();
  const note = h(
    "div",
    {
      class: `toast ${shown}`,
      "data-testid": `toast-${shown}`,
      "data-text": text,
      role: shown === "error" ? "alert" : null,
    },
    h("span", {}, text),
  );
  note.append(iconButton("close", "Close this message", () => note.remove()));
  host.append(note);
  while (host.children.length > 5) host.firstElementChild?.remove();
  setTimeout(() => note.remove(), SHOWN_MS[shown]);
}
