/** Beside the image: the class to draw, what boxes enclose, the frame's objects, and the buttons to other frames. */

import { valuesText } from "../attributes.js";
import { editClasses } from "../classes/classes.js";
import { classColor } from "../colors.js";
import { count, glyph, h, iconButton } from "../dom.js";
import { currentFrame } from "../frame_state.js";
import { makeHash } from "../router.js";
import { DRAGS, progressOf } from "./items.js";

/**
 * @typedef {object} RowActions
 * @property {(item: Item) => void} onOpen
 * @property {(item: Item) => void} onDelete
 * @property {(uid: string) => void} onReview
 */

/** @type {[Api.BoxKind, string, string][]} */
const KINDS = [
  ["silhouette", "Visible part", "Boxes enclose the visible part of the object."],
  ["box", "Whole object", "Boxes enclose the whole object, hidden parts included."],
];

/**
 * Buttons for the classes; the digit keys do the same. The last button changes the classes.
 *
 * @param {ModeApp} app
 * @param {(name: string) => void} onPick
 */
export function createClassPicker(app, onPick) {
  const project = app.state.route.project;
  const root = h("div", { class: "classes", role: "radiogroup", "aria-label": "Class" });
  return {
    root,
    /** @param {string} current */
    show(current) {
      root.replaceChildren(
        ...app.state.project.classes.map((label, index) => {
          const swatch = h("span", { class: "swatch" });
          swatch.style.background = classColor(app.state.project, label);
          const digit = index < 9 ? h("kbd", {}, String(index + 1)) : null;
          return h(
            "button",
            {
              type: "button",
              role: "radio",
              "aria-checked": String(label === current),
              "data-testid": `class-${label}`,
              onclick: () => onPick(label),
            },
            swatch,
            label,
            digit,
          );
        }),
        iconButton("edit", "Change the classes and attributes", () => editClasses(app, project), {
          "data-testid": "edit-classes",
        }),
      );
    },
  };
}

/**
 * The choice of what boxes on the image and on views enclose, which the detectors learn, too.
 *
 * @param {(kind: Api.BoxKind) => void} onKind
 */
export function createKindSwitch(onKind) {
  const help = h("span", { class: "help grow" });
  const buttons = KINDS.map(([kind, text]) =>
    h("button", { type: "button", role: "radio", "data-testid": `kind-${kind}`, onclick: () => onKind(kind) }, text),
  );
  return {
    root: h(
      "div",
      { class: "row kind" },
      h("div", { class: "segments", role: "radiogroup", "aria-label": "What boxes enclose" }, buttons),
      help,
    ),
    /**
     * @param {Api.BoxKind} kind
     * @param {boolean} isReadonly
     */
    show(kind, isReadonly) {
      KINDS.forEach(([name, , text], i) => {
        buttons[i].setAttribute("aria-checked", String(name === kind));
        buttons[i].disabled = isReadonly;
        if (name === kind) help.textContent = text;
      });
    },
  };
}

/**
 * The frame's objects with their progress, and its other 3D boxes.
 *
 * @param {ModeApp} app
 * @param {RowActions} options
 */
export function createObjectList(app, { onOpen, onDelete, onReview }) {
  const list = h("ul", { class: "objects", "data-testid": "objects" });
  const total = h("span", { class: "muted number" });
  return {
    root: h(
      "section",
      { class: "panel list", "aria-label": "Objects of the frame" },
      h("header", {}, h("h2", { class: "grow" }, "Objects"), total),
      list,
    ),
    /** @param {{ items: Item[], current: Item | null, state: FrameState, isReadonly: boolean }} shown */
    show({ items, current, state, isReadonly }) {
      const drawn = new Set(items.map(({ uid }) => uid).filter(Boolean));
      const others = state.labels.filter(({ uid, state: review }) => !drawn.has(uid) && review !== "rejected");
      total.textContent = items.length ? `${items.filter((item) => item.uid).length} of ${items.length} finished` : "";
      const rows = items.map((item) => objectRow(app, item, item === current, isReadonly, { onOpen, onDelete }));
      list.replaceChildren(...rows, ...others.map((label) => labelRow(app, label, onReview)));
      if (!rows.length && !others.length) list.append(h("li", { class: "empty" }, "No objects in this frame yet."));
    },
    clear() {
      total.textContent = "";
      list.replaceChildren();
    },
  };
}

/**
 * @param {ModeApp} app
 * @param {Item} item
 * @param {boolean} isCurrent
 * @param {boolean} isReadonly
 * @param {Pick<RowActions, "onOpen" | "onDelete">} options
 */
function objectRow(app, item, isCurrent, isReadonly, { onOpen, onDelete }) {
  const { label } = item.image_box;
  const done = progressOf(item);
  const text = item.uid ? "finished" : `${done} of ${DRAGS} boxes`;
  const swatch = h("span", { class: "swatch" });
  swatch.style.background = classColor(app.state.project, label);
  const dots = h(
    "span",
    { class: "dots", "aria-hidden": "true" },
    Array.from({ length: DRAGS }, (_, i) => h("i", { class: i < done ? "on" : "" })),
  );
  const open = h(
    "button",
    {
      type: "button",
      class: "quiet entry",
      "aria-current": isCurrent ? "true" : null,
      title: item.uid ? "Show its views" : "Continue this object",
      onclick: () => onOpen(item),
    },
    swatch,
    h("span", { class: "grow ellipsis" }, label),
    dots,
    h("span", { class: item.uid ? "state-accepted" : "muted" }, text),
  );
  const remove = iconButton("trash", `Delete this ${label}`, () => onDelete(item), { disabled: isReadonly });
  return h(
    "li",
    { class: isCurrent ? "current" : "", "data-testid": "object", "data-uid": item.uid, "data-boxes": done },
    open,
    remove,
  );
}

/**
 * @param {ModeApp} app
 * @param {Api.LabelJson} label
 */
const labelTitle = (app, label) => ["Open in Review", valuesText(app, label)].filter(Boolean).join("\n");

/**
 * @param {ModeApp} app
 * @param {Api.LabelJson} label
 * @param {(uid: string) => void} onReview
 */
function labelRow(app, label, onReview) {
  const swatch = h("span", { class: "swatch" });
  swatch.style.background = classColor(app.state.project, label.label);
  const score = label.state === "proposed" && label.score !== null ? ` ${label.score.toFixed(2)}` : "";
  return h(
    "li",
    {},
    h(
      "button",
      { type: "button", class: "quiet entry", title: labelTitle(app, label), onclick: () => onReview(label.uid) },
      swatch,
      h("span", { class: "grow ellipsis" }, label.label),
      h("span", { class: `state-${label.state}` }, label.state + score),
    ),
  );
}

/**
 * Order, previous, next, finalise.
 *
 * @param {Order} order
 * @param {object} listeners
 * @param {() => void} listeners.onPrevious
 * @param {() => void} listeners.onNext
 * @param {() => void} listeners.onFinalise
 * @param {(by: OrderName) => void} listeners.onOrder
 */
export function createFrameBar(order, { onPrevious, onNext, onFinalise, onOrder }) {
  /** @type {HTMLSelectElement} */
  const select = h(
    "select",
    {
      "aria-label": "Order of the frames",
      "data-testid": "order",
      onchange: () => onOrder(select.value === "time" ? "time" : "teach"),
    },
    h("option", { value: "teach" }, "Most useful first"),
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
      h(
        "button",
        { type: "button", title: "Previous frame", onclick: onPrevious, "data-testid": "previous-frame" },
        glyph("previous"),
        h("kbd", {}, "P"),
        h("span", { class: "visually-hidden" }, "Previous frame"),
      ),
      h(
        "button",
        { type: "button", class: "primary", title: "Next frame", onclick: onNext, "data-testid": "next-frame" },
        "Next ",
        h("kbd", {}, "N"),
        glyph("next"),
      ),
      h("span", { class: "grow" }),
      finalise,
    ),
  );
  return {
    root,
    /** @param {FrameState} state */
    show(state) {
      select.value = order.by;
      const left = order.by === "teach" ? order.remaining : null;
      note.textContent = left === null ? "" : `${left} left`;
      note.title = left === null ? "" : `${count(left, "frame")} to label`;
      finalise.hidden = false;
      finalise.replaceChildren(glyph("lock"), state.frame.finalised ? "Reopen" : "Finalise");
      finalise.title = state.frame.finalised
        ? "Allow changes to this frame again"
        : "Lock the frame: no drawing here, no changes by automatic passes (Ctrl+Enter)";
    },
    clear() {
      finalise.hidden = true;
    },
  };
}

/**
 * What to do if a project has no frames.
 *
 * @param {string} project
 */
export function noFrames(project) {
  return h(
    "div",
    { class: "empty", "data-testid": "no-frames" },
    h("h2", {}, `${project} has no recording yet`),
    h("p", {}, "Add one on the start page; its frames are then shown here."),
    h("a", { class: "button", href: "#/" }, "Go to the start page"),
  );
}

/**
 * @param {ModeApp} app
 * @param {string} uid
 */
export function reviewHash(app, uid) {
  return makeHash(app.state.route.project, "review", currentFrame(app).frame.id, { uid });
}
