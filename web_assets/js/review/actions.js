/** The row of buttons under the pictures: the same as the keys, for the mouse and for those who look for them. */

import { h, iconButton } from "../dom.js";

export function createActions(host, act) {
  const button = (id, text, key, kind = "") => h("button", { type: "button", class: kind, title: `${text} (${key})`, "data-testid": `act-${id}`, onclick: () => act[id]() }, text, h("kbd", {}, key));
  const accept = button("accept", "Accept", "Space", "primary");
  const reject = button("reject", "Reject", "X");
  const refit = button("refit", "Fit again", "G");
  const flip = button("flip", "Turn 90°", "F");
  const copy = button("copy", "Copy previous", "C");
  const next = button("next", "Propose next", "V");
  const draw = button("draw", "New box", "B");
  const remove = iconButton("trash", "Delete the box (Del)", () => act.remove(), { "data-testid": "act-delete" });
  const finalise = h("button", { type: "button", "data-testid": "act-finalise", onclick: () => act.finalise() });
  const gizmo = h(
    "div",
    { class: "segments", role: "group", "aria-label": "Gizmo in the 3D view" },
    [["translate", "Move", "T"], ["rotate", "Turn", "R"], ["off", "Off", "Y"]].map(([mode, text, key]) =>
      h("button", { type: "button", "data-mode": mode, title: `Gizmo: ${text.toLowerCase()} (${key})`, "data-testid": `gizmo-${mode}`, onclick: () => act.gizmo(mode) }, text, h("kbd", {}, key)),
    ),
  );
  host.replaceChildren(accept, reject, remove, h("span", { class: "divider" }), refit, flip, h("span", { class: "divider" }), gizmo, h("span", { class: "grow" }), draw, copy, next, finalise);

  return {
    show({ label, frame, gizmo_mode, busy, is_drawing }) {
      for (const one of [accept, reject, refit, flip, remove]) one.disabled = !label || busy;
      accept.firstChild.textContent = label && label.state !== "proposed" && label.state !== "rejected" ? "Next" : "Accept";
      copy.disabled = !frame || frame.frame.previous === null || busy;
      next.disabled = !frame || frame.frame.next === null || busy;
      next.title = "Propose boxes in the next frame, starting from this frame's reviewed ones, and go there (V)";
      draw.disabled = !frame || busy || frame.frame.finalised;
      draw.setAttribute("aria-pressed", String(is_drawing));
      finalise.disabled = !frame || busy;
      finalise.textContent = frame?.frame.finalised ? "Reopen frame" : "Finalise frame";
      finalise.title = frame?.frame.finalised ? "Let automatic passes change this frame again (Ctrl+Enter)" : "All boxes of this frame are right: automatic passes leave it alone (Ctrl+Enter)";
      for (const one of gizmo.children) one.setAttribute("aria-pressed", String(one.dataset.mode === gizmo_mode));
    },
  };
}
