/**
 * The pseudo-views of the current object: front and side of all points in its image box, and below them front and side
 * of the object alone.
 */

import { classColor } from "../colors.js";
import { button, h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { filledBoxes, suggestionsOf } from "./draft.js";
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

export function createViewsPane(/** @type {Work} */ work) {
  const panes = VIEWS.map(([name, testid], index) => makePane(name, testid, index));
  const messages = [0, 1].map((step) =>
    h("p.views-message", { role: "status", "data-testid": step ? "views-message-2" : "views-message" }),
  );
  const source = h("p.muted.views-source", { role: "status", "data-testid": "views-source" });
  const kinds = KINDS.map(([kind, text, title]) =>
    button(text, () => work.setKind(kind), {
      role: "radio",
      title,
      "aria-checked": "false",
      "data-testid": `kind-${kind}`,
    }),
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
      until: work.until,
      color: ({ label }) => classColor(work.app.state.project, label),
      newLabel: () => work.draft?.item.image_box.label ?? "",
      onChange(boxes, why, changed, actions) {
        if (why === "delete") work.objects.clearViewBox(index, actions);
        else work.objects.setViewBox(index, boxes[changed], actions);
      },
    });
    host.append(caption);
    return { editor, element: host, caption, name };
  }

  /** @param {Draft | null} draft the current object. */
  function show(draft) {
    for (const editor of editors) editor.setReadonly(work.isReadonly);
    KINDS.forEach(([name], i) => {
      kinds[i].setAttribute("aria-checked", String(name === work.kind));
      kinds[i].disabled = work.isReadonly;
    });
    const views = draft?.answer.steps.flatMap((step) => step.views) ?? [];
    source.textContent = source.title = sourceOf(draft);
    const suggestions = draft ? suggestionsOf(draft) : [];
    pairs.forEach((pair, step) => {
      const text = viewsMessage(draft, step);
      messages[step].textContent = text ?? "";
      pair.classList.toggle("has-views", text === null);
    });
    panes.forEach(({ editor, caption, name }, index) => {
      const view = views[index] ?? null;
      void editor.setPicture(view?.url ?? null, view?.width, view?.height);
      const box = draft?.item.boxes[index] ?? null;
      const suggested = suggestions[index] ?? null;
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
  };
}

// -- what to do next, in one line

const SIDES = ["front", "side"];

export function hintFor(/** @type {Work} */ { draft, isReadonly, notSaved, whole }) {
  if (isReadonly) return "This frame is finalised. Reopen it to change something.";
  if (notSaved.length) return "Click the dashed box marked 'yours, not saved' to save it.";
  if (!draft) return "Select a box, or draw one around an object on the image.";
  const name = draft.item.image_box.label;
  if (whole.offered()) {
    const others = (draft.whole?.boxes.length ?? 0) > 1 ? ", W shows another one" : "";
    return `The ${name} is finished. Space takes the dashed box as the whole ${name}${others}.`;
  }
  if (draft.item.uid && draft.item.boxes.every(Boolean))
    return `The ${name} is finished. Draw a box around the next one.`;
  if (draft.answer.stop) return "Change its box on the image, or delete it. C copies the previous frame's boxes.";
  if (draft.isLoading) return `Looking for the ${name} …`;
  if (!draft.answer.steps.length) return "";
  if (hasSuggestions(draft)) return "Space takes the dashed boxes. Or drag an edge.";
  const step = draft.item.boxes[0] && draft.item.boxes[1] ? 1 : 0;
  const missing = [2 * step, 2 * step + 1].filter((index) => !draft.item.boxes[index]);
  if (!missing.length) return "";
  const where = missing.map((index) => SIDES[index % 2]).join(" and the ");
  return `${progressOf(draft.item)} of 5: draw a box around the ${name} on the ${where} view.`;
}

/** True if Enter would finish an object: each of its views has a box, and some of these are suggested. */
function hasSuggestions(/** @type {Draft} */ draft) {
  return suggestionsOf(draft).some(Boolean) && filledBoxes(draft).every(Boolean);
}

/** The text shown in place of a step's views; null if there are views. */
export function viewsMessage(/** @type {Draft | null} */ draft, /** @type {number} */ step) {
  if (!draft) return step === 1 ? "" : "An object's views appear here once you have drawn its box on the image.";
  const { steps, stop } = draft.answer;
  if (steps[step]) return null;
  if (step === 1) return steps.length ? (stop ?? "Two more views appear here once both boxes are drawn.") : "";
  return stop ?? (draft.isLoading ? "Looking for the object …" : "");
}

/** Which detector suggests the boxes, or why none are suggested. */
export function sourceOf(/** @type {Draft | null} */ draft) {
  if (!draft?.answer.steps.length || draft.isLoading || draft.item.boxes.every(Boolean)) return "";
  const { detector, measured_by: name, note } = draft.answer;
  if (detector === "loading") return "The detector is being loaded …";
  if (!name) return "";
  return note ? `No dashed boxes (${name}): ${note}` : `Dashed boxes: ${name}`;
}
