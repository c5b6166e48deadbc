import { h } from "../dom.js";

/**
 * Gives a select other options; true if the chosen one is gone.
 *
 * @param {HTMLSelectElement} select
 * @param {string} all the option without a value.
 * @param {Map<string, string>} texts of the other options, by their values.
 */
export function refill(select, all, texts) {
  const chosen = select.value;
  select.replaceChildren(
    h("option", { value: "" }, all),
    ...[...texts].map(([value, text]) => h("option", { value }, text)),
  );
  select.value = texts.has(chosen) ? chosen : "";
  return select.value !== chosen;
}
