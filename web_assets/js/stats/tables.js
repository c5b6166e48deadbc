/** Numbers and tables of the statistics. */

import { h } from "../dom.js";

/**
 * @param {number | null | undefined} value
 * @param {number} [digits]
 */
export const number = (value, digits = 1) =>
  value === null || value === undefined
    ? "–"
    : value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
/**
 * A time: hours, or minutes below one hour.
 *
 * @param {number | null | undefined} hours
 */
export function duration(hours) {
  if (hours === null || hours === undefined) return "–";
  const minutes = Math.round(60 * hours);
  if (minutes >= 60) return `${number(hours)} h`;
  return minutes === 0 && hours > 0 ? "under 1 min" : `${minutes} min`;
}
/** @param {number | null | undefined} value */
export const percent = (value) => (value === null || value === undefined ? "–" : `${number(100 * value, 0)} %`);
/**
 * @param {string} title
 * @param {HTMLElement} table
 */
export function section(title, table) {
  return h("section", { class: "panel" }, h("header", {}, h("h2", {}, title)), h("div", { class: "scroll-x" }, table));
}

/**
 * @param {string[]} heads
 * @param {string[][]} rows
 * @param {string} testid
 */
export function table(heads, rows, testid) {
  return h(
    "table",
    { class: "dense", "data-testid": testid },
    h(
      "thead",
      {},
      h(
        "tr",
        {},
        heads.map((text, i) => h("th", { scope: "col", class: i ? "number right" : "" }, text)),
      ),
    ),
    h(
      "tbody",
      {},
      rows.map((cells) =>
        h(
          "tr",
          {},
          cells.map((cell, i) => (i ? h("td", { class: "number right" }, cell) : h("th", { scope: "row" }, cell))),
        ),
      ),
    ),
  );
}
