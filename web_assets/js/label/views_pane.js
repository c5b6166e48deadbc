/** The pseudo-views of the current object: front and side of one step, side by side, with tabs for the two steps. */

import { createEditor } from "../editor2d/editor.js";
import { h } from "../dom.js";

const NAMES = ["Front", "Side"];

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
 * @param {(step: number) => void} listeners.onStep
 * @param {() => string} listeners.newLabel
 */
export function createViewsPane(app, { onBox, onClear, onStep, newLabel }) {
  const tabs = [0, 1].map((step) =>
    h(
      "button",
      { type: "button", role: "tab", class: "quiet", "data-testid": `step-${step + 1}`, onclick: () => onStep(step) },
      `Step ${step + 1}`,
    ),
  );
  const panes = NAMES.map((name, side) => makePane(name, side));
  const message = h("p", { class: "views-message", role: "status", "data-testid": "views-message" });
  const root = h(
    "section",
    { class: "panel views", "aria-label": "Pseudo-views" },
    h(
      "header",
      {},
      h("h2", { class: "grow" }, "Views"),
      h("div", { role: "tablist", class: "row", "aria-label": "Steps" }, tabs),
    ),
    h(
      "div",
      { class: "pair" },
      panes.map(({ element }) => element),
    ),
    message,
  );
  let shownStep = 0;

  /**
   * @param {string} name
   * @param {number} side
   * @returns {Pane}
   */
  function makePane(name, side) {
    const caption = h("span", { class: "view-name" }, name);
    const host = h("div", { class: "view", "data-testid": `view-${name.toLowerCase()}` });
    const editor = createEditor(host, {
      label: `${name} view`,
      single: true,
      classes: app.state.project.classes,
      newLabel,
      onChange(boxes, why, index, actions) {
        const view = 2 * shownStep + side;
        if (why === "delete") onClear(view, actions);
        else onBox(view, boxes[index], actions);
      },
    });
    host.append(caption);
    return { editor, element: host, caption, name, url: null, shown: Promise.resolve(true) };
  }

  /**
   * @param {Draft | null} draft the current object.
   * @param {number} step
   * @param {string | null} text shown in place of views.
   */
  function show(draft, step, text) {
    shownStep = step;
    const views = draft?.steps[step]?.views ?? null;
    tabs.forEach((tab, i) => {
      tab.setAttribute("aria-selected", String(i === step && Boolean(views)));
      tab.disabled = !draft?.steps[i];
      tab.textContent = `Step ${i + 1}${draft?.item.boxes[2 * i] && draft.item.boxes[2 * i + 1] ? " ✓" : ""}`;
    });
    message.textContent = text ?? "";
    message.hidden = !text;
    root.classList.toggle("has-views", Boolean(views));
    /** @param {number} side */
    const isOpen = (side) => !draft?.item.boxes[2 * step + side] && Boolean(draft?.suggestions[2 * step + side]);
    const firstOpen = [0, 1].find(isOpen);
    panes.forEach((pane, side) => {
      const { editor, caption, name } = pane;
      const index = 2 * step + side;
      const view = views?.[side] ?? null;
      showPicture(pane, view);
      const box = draft?.item.boxes[index] ?? null;
      const suggested = box ? null : (draft?.suggestions[index] ?? null);
      const list = box
        ? [{ ...box, caption: "" }]
        : suggested
          ? [{ ...suggested, suggested: true, caption: side === firstOpen ? "Enter" : "" }]
          : [];
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
