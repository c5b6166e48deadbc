/**
 * The pseudo-views of the current object: front and side of all points in its image box, and below them front and side
 * of the object alone.
 */

import { classColor } from "../colors.js";
import { button, h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { filledBoxes } from "./draft.js";
import { progressOf } from "./items.js";

/** Name and test id of each view. */
const VIEWS = [
  ["Front", "view-front"],
  ["Side", "view-side"],
  ["Object, front", "view-front-2"],
  ["Object, side", "view-side-2"],
];

/** @type {[Api.BoxKind, string, string][]} */
const KINDS = [
  ["silhouette", "Visible part", "Boxes enclose the visible part of the object."],
  ["box", "Whole object", "Boxes enclose the whole object, hidden parts included."],
];

/**
 * @param {ModeApp} app
 * @param {object} listeners
 * @param {(index: number, box: Box2D, actions: number) => void} listeners.onBox called when a
 *     box was set on view `index` (0 to 3).
 * @param {(index: number, actions: number) => void} listeners.onClear called when a view's box was deleted.
 * @param {(kind: Api.BoxKind) => void} listeners.onKind called with what the boxes are to enclose.
 * @param {() => string} listeners.newLabel
 */
export function createViewsPane(app, { onBox, onClear, onKind, newLabel }) {
  const panes = VIEWS.map(([name, testid], index) => makePane(name, testid, index));
  const messages = [0, 1].map((step) =>
    h("p.views-message", { role: "status", "data-testid": step ? "views-message-2" : "views-message" }),
  );
  const source = h("p.muted.views-source", { role: "status", "data-testid": "views-source" });
  const kinds = KINDS.map(([kind, text, title]) =>
    button(text, () => onKind(kind), { role: "radio", title, "aria-checked": "false", "data-testid": `kind-${kind}` }),
  );
  const pairs = [0, 1].map((step) =>
    h("div.pair", panes[2 * step].element, panes[2 * step + 1].element, messages[step]),
  );
  const root = h(
    "section.panel.views",
    { "aria-label": "Pseudo-views" },
    h(
      "header",
      h("h2", "Pseudo-views"),
      h("div.segments", { role: "radiogroup", "aria-label": "What boxes enclose" }, kinds),
    ),
    h("div.pairs", pairs),
    source,
  );

  function makePane(/** @type {string} */ name, /** @type {string} */ testid, /** @type {number} */ index) {
    const caption = h("span.view-name", name);
    const host = h("div.view", { "data-testid": testid });
    const editor = createEditor(host, {
      label: `${name} view`,
      single: true,
      color: ({ label }) => classColor(app.state.project, label),
      newLabel,
      onChange(boxes, why, changed, actions) {
        if (why === "delete") onClear(index, actions);
        else onBox(index, boxes[changed], actions);
      },
    });
    host.append(caption);
    return { editor, element: host, caption, name };
  }

  /** @param {Draft | null} draft the current object. */
  function show(draft) {
    const views = draft?.steps.flatMap((step) => step.views) ?? [];
    source.textContent = source.title = sourceOf(draft);
    pairs.forEach((pair, step) => {
      const text = viewsMessage(draft, step);
      messages[step].textContent = text ?? "";
      pair.classList.toggle("has-views", text === null);
    });
    panes.forEach(({ editor, caption, name }, index) => {
      const view = views[index] ?? null;
      void editor.setPicture(view?.url ?? null, view?.width, view?.height);
      const box = draft?.item.boxes[index] ?? null;
      const suggested = box ? null : (draft?.suggestions[index] ?? null);
      const list = box ? [{ ...box, caption: "" }] : suggested ? [{ ...suggested, suggested: true, caption: "" }] : [];
      if (!editor.isDragging) editor.setBoxes(view ? list : [], 0);
      caption.textContent = box ? `${name} ✓` : name;
    });
  }

  const editors = panes.map(({ editor }) => editor);
  return {
    root,
    show,
    editors,
    showKind(/** @type {Api.BoxKind} */ kind, /** @type {boolean} */ isReadonly) {
      KINDS.forEach(([name], i) => {
        kinds[i].setAttribute("aria-checked", String(name === kind));
        kinds[i].disabled = isReadonly;
      });
    },
    setReadonly(/** @type {boolean} */ value) {
      for (const editor of editors) editor.setReadonly(value);
    },
    destroy() {
      for (const editor of editors) editor.destroy();
    },
  };
}

// -- what to do next, in one line

const SIDES = ["front", "side"];

/** @param {{draft: Draft | null, isReadonly: boolean, notSaved: number, isWholeOffered: boolean}} situation */
export function hintFor({ draft, isReadonly, notSaved, isWholeOffered }) {
  if (isReadonly) return "This frame is finalised. Reopen it to change something.";
  if (notSaved) return "Click the dashed box marked 'yours, not saved' to save it.";
  if (!draft) return "Select a box, or draw one around an object on the image.";
  const name = draft.item.image_box.label;
  if (isWholeOffered) {
    const others = (draft.whole?.boxes.length ?? 0) > 1 ? ", W shows another one" : "";
    return `The ${name} is finished. Space takes the dashed box as the whole ${name}${others}.`;
  }
  if (draft.item.uid && draft.item.boxes.every(Boolean))
    return `The ${name} is finished. Draw a box around the next one.`;
  if (draft.stop) return "Change its box on the image, or delete it. C copies the previous frame's boxes.";
  if (draft.isLoading) return `Looking for the ${name} …`;
  if (!draft.steps.length) return "";
  if (hasSuggestions(draft)) return "Space takes the dashed boxes. Or drag an edge.";
  const step = draft.item.boxes[0] && draft.item.boxes[1] ? 1 : 0;
  const missing = [2 * step, 2 * step + 1].filter((index) => !draft.item.boxes[index]);
  if (!missing.length) return "";
  const where = missing.map((index) => SIDES[index % 2]).join(" and the ");
  return `${progressOf(draft.item)} of 5: draw a box around the ${name} on the ${where} view.`;
}

/** True if Enter would finish an object: each of its views has a box, and some of these are suggested. */
function hasSuggestions(/** @type {Draft} */ draft) {
  return draft.suggestions.some(Boolean) && filledBoxes(draft).every(Boolean);
}

/** The text shown in place of a step's views; null if there are views. */
export function viewsMessage(/** @type {Draft | null} */ draft, /** @type {number} */ step) {
  if (draft?.steps[step]) return null;
  if (step === 1) {
    if (!draft?.steps.length) return "";
    return draft.stop ?? "Two more views appear here once both boxes are drawn.";
  }
  if (!draft) return "An object's views appear here once you have drawn its box on the image.";
  return draft.stop ?? (draft.isLoading ? "Looking for the object …" : "");
}

/** Which detector suggests the boxes, or why none are suggested. */
export function sourceOf(/** @type {Draft | null} */ draft) {
  if (!draft?.steps.length || draft.isLoading || draft.item.boxes.every(Boolean)) return "";
  if (draft.detector === "loading") return "The detector is being loaded …";
  if (!draft.measuredBy) return "";
  return draft.note ? `No dashed boxes (${draft.measuredBy}): ${draft.note}` : `Dashed boxes: ${draft.measuredBy}`;
}
