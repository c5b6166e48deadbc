/** Beside the image: the class to draw, what boxes enclose, the frame's objects, and the buttons to other frames. */

import { valuesText } from "../attributes.js";
import { classColor } from "../colors.js";
import { button, count, glyph, h, iconButton, patch } from "../dom.js";
import { currentFrame } from "../frame_state.js";
import { headingMark } from "../heading_mark.js";
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

/** The choice of what boxes on the image and on views enclose, which the detectors learn, too. */
export function createKindSwitch(/** @type {(kind: Api.BoxKind) => void} */ onKind) {
  const help = h("span", { class: "help grow" });
  const buttons = KINDS.map(([kind, text]) =>
    button(text, () => onKind(kind), { role: "radio", "aria-checked": "false", "data-testid": `kind-${kind}` }),
  );
  return {
    root: h(
      "div",
      { class: "row kind" },
      h("div", { class: "segments", role: "radiogroup", "aria-label": "What boxes enclose" }, buttons),
      help,
    ),
    show(/** @type {Api.BoxKind} */ kind, /** @type {boolean} */ isReadonly) {
      KINDS.forEach(([name, , text], i) => {
        buttons[i].setAttribute("aria-checked", String(name === kind));
        buttons[i].disabled = isReadonly;
        if (name === kind) help.textContent = text;
      });
    },
  };
}

/** The frame's objects with their progress, and its other 3D boxes. */
export function createObjectList(
  /** @type {ModeApp} */ app,
  /** @type {RowActions} */ { onOpen, onDelete, onReview },
) {
  const list = h("ul", { class: "objects", "data-testid": "objects" });
  const total = h("span", { class: "muted number" });
  return {
    root: h(
      "section",
      { class: "panel list", "aria-label": "Objects of the frame" },
      h("header", {}, h("h2", { class: "grow" }, "Objects"), total),
      list,
    ),
    show(
      /** @type {{ items: Item[], current: Item | null, state: FrameState, isReadonly: boolean }} */ {
        items,
        current,
        state,
        isReadonly,
      },
    ) {
      const drawn = new Set(items.map(({ uid }) => uid).filter(Boolean));
      const others = state.labels.filter(({ uid, state: review }) => !drawn.has(uid) && review !== "rejected");
      total.textContent = items.length ? `${items.filter((item) => item.uid).length} of ${items.length} finished` : "";
      const rows = items.map((item) => {
        const label = state.labels.find(({ uid }) => uid === item.uid);
        const mark = label ? headingMark(label, state.up) : h("span", { class: "heading-mark" });
        return objectRow(app, item, mark, item === current, isReadonly, { onOpen, onDelete });
      });
      rows.push(...others.map((label) => labelRow(app, label, onReview)));
      patch(list, rows.length ? rows : h("li", { class: "empty" }, "No objects in this frame yet."));
    },
    clear() {
      total.textContent = "";
      list.replaceChildren();
    },
  };
}

function objectRow(
  /** @type {ModeApp} */ app,
  /** @type {Item} */ item,
  /** @type {HTMLElement} */ mark,
  /** @type {boolean} */ isCurrent,
  /** @type {boolean} */ isReadonly,
  /** @type {Pick<RowActions, "onOpen" | "onDelete">} */ { onOpen, onDelete },
) {
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
  const open = button(
    [
      swatch,
      h("span", { class: "grow ellipsis" }, label),
      mark,
      dots,
      h("span", { class: item.uid ? "state-accepted" : "muted" }, text),
    ],
    () => onOpen(item),
    {
      class: "quiet entry",
      "aria-current": isCurrent ? "true" : null,
      title: item.uid ? "Show its views" : "Continue this object",
    },
  );
  const remove = iconButton("trash", `Delete this ${label}`, () => onDelete(item), { disabled: isReadonly });
  return h(
    "li",
    {
      class: isCurrent ? "current" : "",
      "data-testid": "object",
      "data-uid": item.uid,
      "data-key": item.uid,
      "data-boxes": done,
    },
    open,
    remove,
  );
}

const labelTitle = (/** @type {ModeApp} */ app, /** @type {Api.LabelJson} */ label) =>
  ["Open in Review", valuesText(app, label)].filter(Boolean).join("\n");

function labelRow(
  /** @type {ModeApp} */ app,
  /** @type {Api.LabelJson} */ label,
  /** @type {(uid: string) => void} */ onReview,
) {
  const swatch = h("span", { class: "swatch" });
  swatch.style.background = classColor(app.state.project, label.label);
  const score = label.state === "proposed" && label.score !== null ? ` ${label.score.toFixed(2)}` : "";
  return h(
    "li",
    { "data-key": label.uid },
    button(
      [
        swatch,
        h("span", { class: "grow ellipsis" }, label.label),
        headingMark(label, currentFrame(app).up),
        h("span", { class: `state-${label.state}` }, label.state + score),
      ],
      () => onReview(label.uid),
      { class: "quiet entry", title: labelTitle(app, label) },
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
  const finalise = button([], onFinalise, { hidden: true, "data-testid": "finalise" });
  const root = h(
    "footer",
    { class: "panel frame-bar" },
    h("div", { class: "row" }, h("label", { class: "row" }, h("span", {}, "Order"), select), note),
    h(
      "div",
      { class: "row" },
      button(
        [glyph("previous"), h("kbd", {}, "P"), h("span", { class: "visually-hidden" }, "Previous frame")],
        onPrevious,
        { title: "Previous frame", "data-testid": "previous-frame" },
      ),
      button(["Next ", h("kbd", {}, "N"), glyph("next")], onNext, {
        class: "primary",
        title: "Next frame",
        "data-testid": "next-frame",
      }),
      h("span", { class: "grow" }),
      finalise,
    ),
  );
  return {
    root,
    show(/** @type {FrameState} */ state) {
      select.value = order.by;
      const left = order.by === "teach" ? order.remaining : null;
      note.textContent = left === null ? "" : `${left} left`;
      note.title = left === null ? "" : `${count(left, "frame")} to label`;
      finalise.hidden = false;
      patch(finalise, glyph("lock"), state.frame.finalised ? "Reopen" : "Finalise");
      finalise.title = state.frame.finalised
        ? "Allow changes to this frame again"
        : "Lock the frame: no drawing here, no changes by automatic passes (Ctrl+Enter)";
    },
    clear() {
      finalise.hidden = true;
    },
  };
}

/** What to do if a project has no frames. */
export function noFrames(/** @type {string} */ project) {
  return h(
    "div",
    { class: "empty", "data-testid": "no-frames" },
    h("h2", {}, `${project} has no recording yet`),
    h("p", {}, "Add one on the start page; its frames are then shown here."),
    h("a", { class: "button", href: "#/" }, "Go to the start page"),
  );
}

export function reviewHash(/** @type {ModeApp} */ app, /** @type {string} */ uid) {
  return makeHash(app.state.route.project, "review", currentFrame(app).frame.id, { uid });
}
