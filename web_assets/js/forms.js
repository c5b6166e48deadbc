/** The parts of forms: fields with their names, choices, what was typed the last time, and what is wrong. */

import { h } from "./dom.js";
import { messageOf } from "./errors.js";

/** A control below its name. */
export function field(
  /** @type {Child} */ name,
  /** @type {HTMLElement} */ control,
  /** @type {Child} */ help = null,
) {
  return h("label.field", h("span", name), control, help && h("span.help", help));
}

/**
 * A choice from values with their texts.
 *
 * @param {readonly (readonly string[])[]} rows a value, and its text if that is another.
 * @param {Attributes} attributes
 * @param {string} [chosen] the value that is chosen at first, if it is not the first one.
 */
export function select(rows, attributes, chosen) {
  const options = rows.map(([value, text = value]) => h("option", { value, selected: value === chosen }, text));
  return h("select", attributes, options);
}

export function checkbox(
  /** @type {string | null} */ testid,
  /** @type {boolean} */ checked = false,
  /** @type {Attributes} */ more = {},
) {
  return h("input", { type: "checkbox", checked, "data-testid": testid, ...more });
}

/** A field for a number, which has no name beside it. */
export const numberField = (
  /** @type {string} */ testid,
  /** @type {string} */ label,
  /** @type {Attributes} */ more,
) => h("input", { type: "number", "aria-label": label, "data-testid": testid, ...more });

/** The values of those boxes that are ticked. */
export const ticked = (/** @type {HTMLInputElement[]} */ boxes) =>
  boxes.filter((box) => box.checked).map((box) => box.value);

/** The parts of a text between separators; empty ones are left out. */
export const partsOf = (/** @type {string} */ text, /** @type {string} */ separator) =>
  text.split(separator).flatMap((part) => part.trim() || []);

/** Choices of a form that belong together, with a name above them. */
export const group = (/** @type {string} */ legend, /** @type {Children[]} */ ...rows) =>
  h("fieldset.plain", h("legend.field-label", legend), ...rows);

/** A number field; null while it is empty. */
export const numberOf = (/** @type {HTMLInputElement} */ { value, valueAsNumber }) =>
  value === "" ? null : valueAsNumber;

/** What is wrong, an error or a text; hidden as long as that is nothing. */
export function errorBox(/** @type {unknown} */ problem = null, /** @type {string | null} */ testid = null) {
  const box = h("p.error-box", { role: "alert", "data-testid": testid });
  showProblem(box, problem);
  return box;
}

/** Shows in an `errorBox` what is wrong; null: nothing. */
export function showProblem(/** @type {HTMLElement} */ box, /** @type {unknown} */ problem) {
  box.textContent = problem === null ? "" : messageOf(problem);
  box.hidden = problem === null;
}

/**
 * Shows what was typed or chosen in a field of a form in this project the last time, and keeps it in this browser.
 *
 * @template {HTMLInputElement | HTMLSelectElement} T
 * @param {App} app
 * @param {string} of the form.
 * @param {string} what the field.
 * @param {T} field
 */
export function remembered(app, of, what, field) {
  const key = `${of} ${app.state.route.project} ${what}`;
  const name = field instanceof HTMLInputElement && field.type === "checkbox" ? "checked" : "value";
  const kept = localStorage.getItem(key);
  const before = field.value;
  if (kept !== null) Object.assign(field, { [name]: name === "checked" ? kept === "true" : kept });
  // a choice that is offered no more
  if (field instanceof HTMLSelectElement && field.selectedIndex < 0) field.value = before;
  field.addEventListener("change", () => localStorage.setItem(key, String(Reflect.get(field, name))));
  return field;
}

/**
 * Enter in a field does this, and not what its form does.
 *
 * @param {(event: KeyboardEvent) => unknown} fn
 * @returns {(event: KeyboardEvent) => void}
 */
export function onEnter(fn) {
  return (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    event.stopPropagation();
    fn(event);
  };
}
