/**
 * The pseudo-views of the current object: front and side of all points in its image box, and below them front and side
 * of the object alone.
 */

import { classColor } from "../colors.js";
import { createEditor } from "../editor2d/editor.js";
import { h } from "../dom.js";
import { filledBoxes } from "./draft.js";
import { sourceOf, viewsMessage } from "./hints.js";

/** Name and test id of each view. */
const VIEWS = [
  ["Front", "view-front"],
  ["Side", "view-side"],
  ["Object, front", "view-front-2"],
  ["Object, side", "view-side-2"],
];

/**
 * @typedef {object} Pane
 * @property {Editor} editor
 * @property {HTMLElement} element
 * @property {HTMLElement} caption
 * @property {string} name
 * @property {string | null} url
 * @property {Promise<boolean>} shown
 */

/**
 * @param {ModeApp} app
 * @param {object} listeners
 * @param {(index: number, box: Box2D, actions: number) => void} listeners.onBox called when a
 *     box was set on view `index` (0 to 3).
 * @param {(index: number, actions: number) => void} listeners.onClear called when a view's box was deleted.
 * @param {() => boolean} listeners.onAcceptAll accepts all suggested boxes.
 * @param {() => string} listeners.newLabel
 */
export function createViewsPane(app, { onBox, onClear, onAcceptAll, newLabel }) {
  const panes = VIEWS.map(([name, testid], index) => makePane(name, testid, index));
  const messages = [0, 1].map((step) =>
    h("p", { class: "views-message", role: "status", "data-testid": step ? "views-message-2" : "views-message" }),
  );
  const accept = h(
    "button",
    { type: "button", class: "primary", hidden: true, "data-testid": "accept-all", onclick: () => onAcceptAll() },
    "Accept ",
    h("kbd", {}, "Enter"),
  );
  const source = h("p", { class: "muted views-source", role: "status", "data-testid": "views-source" });
  const pairs = [0, 1].map((step) =>
    h("div", { class: "pair" }, panes[2 * step].element, panes[2 * step + 1].element, messages[step]),
  );
  const root = h(
    "section",
    { class: "panel views", "aria-label": "Pseudo-views" },
    h("header", {}, h("h2", { class: "grow" }, "Views"), accept),
    h("div", { class: "pairs" }, pairs),
    source,
  );

  /**
   * @param {string} name
   * @param {string} testid
   * @param {number} index
   * @returns {Pane}
   */
  function makePane(name, testid, index) {
    const caption = h("span", { class: "view-name" }, name);
    const host = h("div", { class: "view", "data-testid": testid });
    const editor = createEditor(host, {
      label: `${name} view`,
      single: true,
      color: ({ label }) => classColor(app.state.project, label),
      newLabel,
      onEnter: onAcceptAll,
      onChange(boxes, why, changed, actions) {
        if (why === "delete") onClear(index, actions);
        else onBox(index, boxes[changed], actions);
      },
    });
    host.append(caption);
    return { editor, element: host, caption, name, url: null, shown: Promise.resolve(true) };
  }

  /** @param {Draft | null} draft the current object. */
  function show(draft) {
    const views = draft?.steps.flatMap((step) => step.views) ?? [];
    const canAccept = draft && !draft.isLoading && draft.suggestions.some(Boolean);
    accept.hidden = !(canAccept && filledBoxes(draft).every(Boolean));
    source.textContent = sourceOf(draft);
    pairs.forEach((pair, step) => {
      const text = viewsMessage(draft, step);
      messages[step].textContent = text ?? "";
      pair.classList.toggle("has-views", text === null);
      pair.hidden = text === "";
    });
    panes.forEach((pane, index) => {
      const { editor, caption, name } = pane;
      const view = views[index] ?? null;
      showPicture(pane, view);
      const box = draft?.item.boxes[index] ?? null;
      const suggested = box ? null : (draft?.suggestions[index] ?? null);
      const list = box ? [{ ...box, caption: "" }] : suggested ? [{ ...suggested, suggested: true, caption: "" }] : [];
      if (!editor.isDragging) editor.setBoxes(view ? list : [], 0);
      caption.textContent = box ? `${name} ✓` : name;
    });
  }

  /**
   * @param {Pane} pane
   * @param {Api.ViewJson | null} view
   */
  function showPicture(pane, view) {
    const url = view?.url ?? null;
    const shown = pane.editor.setPicture(url, view?.width, view?.height);
    // for the same picture the editor resolves at once, although it may still be loading
    if (url !== pane.url) pane.shown = shown;
    pane.url = url;
  }

  const editors = panes.map(({ editor }) => editor);
  return {
    root,
    show,
    editors,
    /** Resolves when the pictures are on the screen. */
    shown: () => Promise.all(panes.map((pane) => pane.shown)),
    /** @param {boolean} value */
    setReadonly(value) {
      for (const editor of editors) editor.setReadonly(value);
    },
    destroy() {
      for (const editor of editors) editor.destroy();
    },
  };
}
