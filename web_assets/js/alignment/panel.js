/** The parts of a panel beside the picture. */

import { h } from "../dom.js";

/** Values that differ by less are equal. */
export const SAME = 1e-9;

export function panel(
  /** @type {string} */ title,
  /** @type {HTMLElement[]} */ parts,
  /** @type {HTMLElement[]} */ buttons,
  /** @type {HTMLElement} */ help,
) {
  const body = h("div.body.stack", parts, h("div.row.wrap", buttons), help);
  return h("section.panel", h("header", h("h2", title)), body);
}

// -- a slider with a field for its number; both change together

/**
 * @param {{ label: string, testid: string, most: number, step: number, unit: string, onChange: () => void }} options
 *     `most`: the slider's greatest value, and minus its least one; the field takes any number.
 */
export function createSlider({ label, testid, most, step, unit, onChange }) {
  let value = 0;
  const decimals = Math.max(0, Math.ceil(-Math.log10(step)));
  const range = h("input", { type: "range", min: -most, max: most, step, value: "0", "data-testid": testid });
  range.setAttribute("aria-label", label);
  range.addEventListener("input", () => change(Number(range.value)));
  const start = (0).toFixed(decimals);
  const field = h("input", { type: "number", step, class: "number", value: start, "data-testid": `${testid}-field` });
  field.setAttribute("aria-label", `${label}, ${unit}`);
  field.addEventListener("input", () => {
    if (Number.isFinite(field.valueAsNumber)) change(field.valueAsNumber);
  });
  const root = h("div.slider", h("span", label), range, field, h("span.muted", unit));

  function change(/** @type {number} */ next) {
    value = next;
    if (document.activeElement !== field) field.value = next.toFixed(decimals);
    if (document.activeElement !== range) range.value = String(next);
    onChange();
  }

  return {
    root,
    get value() {
      return value;
    },
    set(/** @type {number} */ next) {
      value = next;
      range.value = String(next);
      field.value = next.toFixed(decimals);
    },
  };
}
