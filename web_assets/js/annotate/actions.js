/** The row of buttons under the pictures, which do the same as the keys. */

import { button, h, iconButton } from "../dom.js";
import { KEYS } from "../keys.js";
import { isOpen } from "./desk.js";

const GIZMOS = { translate: "Move", rotate: "Turn", off: "Off" };

export function createActions(/** @type {Annotate} */ at) {
  const { app, desk, queue, opening, teach } = at;
  const act = at.commands.keys;

  /** A button that does the same as a key, with the help and the name of that key. */
  function action(/** @type {string} */ id, /** @type {Child} */ text, /** @type {Attributes} */ more = {}) {
    const { label, keys } = KEYS.find((row) => row.id === id) ?? { label: "", keys: [] };
    const attributes = { title: `${label} (${keys[0]})`, "data-testid": `act-${id.split("-")[0]}`, ...more };
    return button([text, h("kbd", keys[0])], () => act[id](""), attributes);
  }

  const word = h("span", "Accept");
  const accept = action("accept", word, { class: "primary" });
  const reject = action("reject", "Reject");
  const refit = action("refit", "Fit again");
  const turn = action("turn", "Turn");
  const copy = action("copy-previous", "Copy previous");
  const follow = action("follow", "Follow");
  const draw = action("draw-box", "New box");
  const remove = iconButton("trash", "Delete the box (Del)", () => act.delete(""), { "data-testid": "act-delete" });
  const finalise = button([], () => act.finalise(""), { "data-testid": "act-finalise" });
  const gizmo = h(
    "div.segments",
    { role: "group", "aria-label": "Gizmo in the 3D view" },
    Object.entries(GIZMOS).map(([mode, text]) =>
      action(`gizmo-${mode}`, text, { "data-mode": mode, "data-testid": `gizmo-${mode}` }),
    ),
  );
  const views = [false, true].map((on) =>
    button(on ? ["Pseudo-views", h("kbd", "D")] : "Along the box", () => teach.turn(on), {
      title: on
        ? "The views that teach the detectors, with their 2D boxes (D)"
        : "Three views along the box's axes (D)",
      "data-testid": on ? "views-pseudo" : "views-along",
    }),
  );
  at.parts.actions.replaceChildren(
    accept,
    reject,
    remove,
    h("span.divider"),
    refit,
    turn,
    h("span.divider"),
    h("div.segments", { role: "group", "aria-label": "Views of the object" }, views),
    h("span.grow"),
    draw,
    copy,
    follow,
    finalise,
  );

  return {
    /** For the bar above the 3D view. */
    gizmo,
    show() {
      const { frame } = app.state;
      const { shown: label } = desk;
      const { canAccept } = teach;
      const busy = opening.loading;
      // there are proposals, here or in the queue that is worked
      const isMoreOpen = (opening.inQueue && queue.items.length > 0) || desk.labels().some(isOpen);
      for (const one of [reject, refit, turn, remove]) one.disabled = !label || busy;
      const isReviewed = label?.state === "accepted" || label?.state === "edited";
      accept.disabled = busy || !((label && !isReviewed) || isMoreOpen || canAccept);
      for (const [i, one] of views.entries()) one.setAttribute("aria-pressed", String(teach.isOn === (i === 1)));
      const [text, title] =
        (isReviewed || !label) && !canAccept
          ? ["Next", "Next open box of this frame, or of the queue (Space)"]
          : ["Accept", "Accept (Space)"];
      word.textContent = text;
      accept.title = title;
      copy.disabled = !frame || frame.frame.previous === null || busy || frame.frame.finalised;
      follow.disabled = !frame || frame.frame.next === null || !(isReviewed || label?.isNew) || busy;
      draw.disabled = !frame || busy || frame.frame.finalised;
      draw.setAttribute("aria-pressed", String(at.image.isDrawing));
      finalise.disabled = !frame || busy;
      finalise.textContent = frame?.frame.finalised ? "Reopen frame" : "Finalise frame";
      finalise.title = frame?.frame.finalised
        ? "Allow automatic passes to change this frame again (Ctrl+Enter)"
        : "All boxes of this frame are right: automatic passes will not change it (Ctrl+Enter)";
      for (const one of gizmo.children)
        one.setAttribute("aria-pressed", String(one.getAttribute("data-mode") === at.scene.gizmo));
    },
  };
}
