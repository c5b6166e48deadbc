/** The parts of a panel beside the picture. */

import { h } from "../dom.js";

/** Values that differ by less are equal. */
export const SAME = 1e-9;

/**
 * @param {string} title
 * @param {HTMLElement[]} parts
 * @param {HTMLElement[]} buttons
 * @param {HTMLElement} help
 */
export function panel(title, parts, buttons, help) {
  const body = h("div", { class: "body stack" }, parts, h("div", { class: "row wrap" }, buttons), help);
  return h("section", { class: "panel" }, h("header", {}, h("h2", {}, title)), body);
}

/**
 * @param {string} label
 * @param {string} testid
 * @param {() => void} onclick
 */
export function button(label, testid, onclick) {
  return h("button", { type: "button", "data-testid": testid, onclick }, label);
}
