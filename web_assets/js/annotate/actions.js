/** The row of buttons under the pictures, which do the same as the keys. */

import { button, h, iconButton } from "../dom.js";
import { isOpen } from "./desk.js";

/** @type {[Api.Gizmo, string, string][]} */
const GIZMOS = [
  ["translate", "Move", "T"],
  ["rotate", "Turn", "R"],
  ["off", "Off", "Y"],
];

export function createActions(/** @type {Annotate} */ at) {
  const { app, desk, queue, opening, teach } = at;
  const act = at.commands.keys;
  const action = (
    /** @type {string} */ id,
    /** @type {string | HTMLElement} */ text,
    /** @type {string} */ key,
    /** @type {string} */ kind = "",
  ) =>
    button([text, h("kbd", key)], () => act[id](""), {
      class: kind,
      title: `${typeof text === "string" ? text : text.textContent} (${key})`,
      "data-testid": `act-${id.split("-")[0]}`,
    });
  const word = h("span", "Accept");
  const accept = action("accept", word, "Space", "primary");
  const reject = action("reject", "Reject", "X");
  const refit = action("refit", "Fit again", "G");
  const turn = action("turn", "Turn", "F");
  turn.title = "Turn the heading by 180° (F), or by 90° (Shift F)";
  const copy = action("copy-previous", "Copy previous", "C");
  const follow = action("follow", "Follow", "V");
  const draw = action("draw-box", "New box", "B");
  const remove = iconButton("trash", "Delete the box (Del)", () => act.delete(""), {
    "data-testid": "act-delete",
  });
  const finalise = button([], () => act.finalise(""), { "data-testid": "act-finalise" });
  const gizmo = h(
    "div.segments",
    { role: "group", "aria-label": "Gizmo in the 3D view" },
    GIZMOS.map(([mode, text, key]) =>
      button([text, h("kbd", key)], () => act[`gizmo-${mode}`](""), {
        "data-mode": mode,
        title: `Gizmo: ${text.toLowerCase()} (${key})`,
        "data-testid": `gizmo-${mode}`,
      }),
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
      follow.title =
        "Follow this reviewed or new box through the recording (V; back: Shift V), or all of this frame (J, Shift J)";
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
