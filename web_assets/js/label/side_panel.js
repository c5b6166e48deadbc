/** Beside the image: the class to draw, what boxes mean, the frame's objects, and the way to the next frame. */

import { classColor } from "../colors.js";
import { count, glyph, h, iconButton } from "../dom.js";
import { makeHash } from "../router.js";
import { DRAGS, progressOf } from "./items.js";

const KINDS = [
  ["silhouette", "What I see", "Boxes end where the visible part of the object ends."],
  ["box", "The whole box", "Boxes enclose the whole object, hidden parts included."],
];

/** Chips to choose the class with; digits do the same. */
export function createClassPicker(app, onPick) {
  const root = h("div", { class: "classes", role: "radiogroup", "aria-label": "Class" });
  return {
    root,
    show(current) {
      root.replaceChildren(
        ...app.state.project.classes.map((label, index) => {
          const swatch = h("span", { class: "swatch" });
          swatch.style.background = classColor(app.state.project.classes, label);
          const digit = index < 9 ? h("kbd", {}, String(index + 1)) : null;
          return h("button", { type: "button", role: "radio", "aria-checked": String(label === current), "data-testid": `class-${label}`, onclick: () => onPick(label) }, swatch, label, digit);
        }),
      );
    },
  };
}

/** What image and view boxes enclose; it tells the detectors what they learn. */
export function createKindSwitch(onKind) {
  const help = h("span", { class: "help grow" });
  const buttons = KINDS.map(([kind, text]) => h("button", { type: "button", role: "radio", "data-testid": `kind-${kind}`, onclick: () => onKind(kind) }, text));
  return {
    root: h("div", { class: "row kind" }, h("div", { class: "segments", role: "radiogroup", "aria-label": "What boxes enclose" }, buttons), help),
    show(kind, is_readonly) {
      KINDS.forEach(([name, , text], i) => {
        buttons[i].setAttribute("aria-checked", String(name === kind));
        buttons[i].disabled = is_readonly;
        if (name === kind) help.textContent = text;
      });
    },
  };
}

/** The frame's objects with their progress, and its other 3D boxes. */
export function createObjectList(app, { onOpen, onDelete, onReview }) {
  const list = h("ul", { class: "objects", "data-testid": "objects" });
  const total = h("span", { class: "muted number" });
  return {
    root: h("section", { class: "panel list", "aria-label": "Objects of the frame" }, h("header", {}, h("h2", { class: "grow" }, "Objects"), total), list),
    show({ items, current, state, is_readonly }) {
      const drawn = new Set(items.map(({ uid }) => uid).filter(Boolean));
      const others = state.labels.filter(({ uid, state: review }) => !drawn.has(uid) && review !== "rejected");
      total.textContent = items.length ? `${items.filter((item) => item.uid).length} of ${items.length} finished` : "";
      const rows = items.map((item) => objectRow(app, item, item === current, is_readonly, { onOpen, onDelete }));
      list.replaceChildren(...rows, ...others.map((label) => labelRow(app, label, onReview)));
      if (!rows.length && !others.length) list.append(h("li", { class: "empty" }, "Nothing labelled on this frame yet."));
    },
    clear() {
      total.textContent = "";
      list.replaceChildren();
    },
  };
}

function objectRow(app, item, is_current, is_readonly, { onOpen, onDelete }) {
  const { label } = item.image_box;
  const done = progressOf(item);
  const text = item.uid ? "finished" : `${done} of ${DRAGS} boxes`;
  const swatch = h("span", { class: "swatch" });
  swatch.style.background = classColor(app.state.project.classes, label);
  const dots = h("span", { class: "dots", "aria-hidden": "true" }, Array.from({ length: DRAGS }, (_, i) => h("i", { class: i < done ? "on" : "" })));
  const open = h(
    "button",
    { type: "button", class: "quiet entry", "aria-current": is_current ? "true" : null, title: item.uid ? "Open its views again" : "Go on with it", onclick: () => onOpen(item) },
    swatch,
    h("span", { class: "grow ellipsis" }, label),
    dots,
    h("span", { class: item.uid ? "state-accepted" : "muted" }, text),
  );
  const remove = iconButton("trash", `Delete this ${label}`, () => onDelete(item), { disabled: is_readonly });
  return h("li", { class: is_current ? "current" : "", "data-testid": "object", "data-uid": item.uid, "data-boxes": done }, open, remove);
}

function labelRow(app, label, onReview) {
  const swatch = h("span", { class: "swatch" });
  swatch.style.background = classColor(app.state.project.classes, label.label);
  const score = label.state === "proposed" && label.score !== null ? ` ${label.score.toFixed(2)}` : "";
  return h(
    "li",
    {},
    h(
      "button",
      { type: "button", class: "quiet entry", title: "Open in Review", onclick: () => onReview(label.uid) },
      swatch,
      h("span", { class: "grow ellipsis" }, label.label),
      h("span", { class: `state-${label.state}` }, label.state + score),
    ),
  );
}

/** Order, previous, next, finalise. */
export function createFrameBar(app, order, { onPrevious, onNext, onFinalise, onOrder }) {
  const select = h(
    "select",
    { "aria-label": "Order of the frames", "data-testid": "order", onchange: () => onOrder(select.value) },
    h("option", { value: "teach" }, "What teaches most"),
    h("option", { value: "time" }, "In time order"),
  );
  const note = h("span", { class: "muted grow ellipsis" });
  const finalise = h("button", { type: "button", hidden: true, "data-testid": "finalise", onclick: onFinalise });
  const root = h(
    "footer",
    { class: "panel frame-bar" },
    h("div", { class: "row" }, h("label", { class: "row" }, h("span", {}, "Order"), select), note),
    h(
      "div",
      { class: "row" },
      h("button", { type: "button", title: "Previous frame", onclick: onPrevious, "data-testid": "previous-frame" }, glyph("previous"), h("kbd", {}, "P"), h("span", { class: "visually-hidden" }, "Previous frame")),
      h("button", { type: "button", class: "primary", title: "Next frame", onclick: onNext, "data-testid": "next-frame" }, "Next ", h("kbd", {}, "N"), glyph("next")),
      h("span", { class: "grow" }),
      finalise,
    ),
  );
  return {
    root,
    show(state) {
      select.value = order.by;
      note.textContent = order.by === "teach" && order.remaining !== null ? `${count(order.remaining, "frame")} to label` : "";
      finalise.hidden = false;
      finalise.replaceChildren(glyph("lock"), state.frame.finalised ? "Reopen frame" : "Finalise");
      finalise.title = state.frame.finalised ? "Let the frame change again" : "Nothing changes on this frame any more, and proposals leave it alone (Ctrl+Enter)";
    },
    clear: () => (finalise.hidden = true),
  };
}

/** What to do where a project has no frames. */
export function noFrames(project) {
  return h(
    "div",
    { class: "empty", "data-testid": "no-frames" },
    h("h2", {}, `${project} has no recording yet`),
    h("p", {}, "Add one on the start page; its frames then show here."),
    h("a", { class: "button", href: "#/" }, "To the start page"),
  );
}

export function reviewHash(app, uid) {
  return makeHash(app.state.route.project, "review", app.state.frame.frame.id, { uid });
}
