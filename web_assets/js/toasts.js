/** Short messages in the corner. An error stays until it is closed or twelve seconds are over. */

import { h, iconButton } from "./dom.js";

const SHOWN_MS = { info: 4000, good: 4000, warn: 8000, error: 12000 };

/** toast("Saved") · toast(error) · toast("text", "warn"): kinds are info, good, warn and error. */
export function toast(message, kind) {
  const is_error = message instanceof Error;
  if (is_error && message.name === "AbortError") return;
  const shown = kind ?? (is_error ? "error" : "info");
  const text = is_error ? message.message : message;
  const host = document.getElementById("toasts");
  for (const old of host.children) if (old.dataset.text === text) old.remove();
  const note = h("div", { class: `toast ${shown}`, "data-testid": `toast-${shown}`, "data-text": text, role: shown === "error" ? "alert" : null }, h("span", {}, text));
  note.append(iconButton("close", "Close this message", () => note.remove()));
  host.append(note);
  while (host.children.length > 5) host.firstElementChild.remove();
  setTimeout(() => note.remove(), SHOWN_MS[shown]);
}
