/** The filter of the queue by the values of an attribute: of boxes, of tracks, or of frames. */

import { nameOf, schemaOf, steps } from "../attributes.js";
import { h, patch } from "../dom.js";

/** `onChange` is called with what the server is to be asked. */
export function createValueFilter(/** @type {ModeApp} */ app, /** @type {(query: ValueQuery) => unknown} */ onChange) {
  /**
   * Each option by its value: its text, what it asks, and what may be typed to ask for less.
   *
   * @type {Map<string, { text: string, query: ValueQuery, typed?: "text" | "number" }>}
   */
  let options = new Map();
  /** @type {HTMLSelectElement} */
  const select = h("select", {
    "aria-label": "Attribute in the queue",
    "data-testid": "queue-attribute",
    onchange: choose,
  });
  const inputs = [
    input("low", "from", "number"),
    input("high", "to", "number"),
    input("contains", "contains", "text"),
  ];
  const root = h("span.value-filter", select, inputs);

  /** @returns {HTMLInputElement} */
  function input(
    /** @type {string} */ name,
    /** @type {string} */ placeholder,
    /** @type {"number" | "text"} */ type,
  ) {
    return h("input", {
      type,
      name,
      step: type === "number" ? "any" : null,
      placeholder,
      hidden: true,
      "aria-label": `Attribute in the queue, ${placeholder}`,
      "data-testid": `queue-${name}`,
      onchange: () => onChange(query()),
    });
  }

  function choose() {
    for (const each of inputs) each.value = "";
    showInputs();
    const first = inputs.find(({ hidden }) => !hidden);
    if (first) first.focus();
    else select.blur();
    onChange(query());
  }

  function showInputs() {
    for (const each of inputs) each.hidden = each.type !== options.get(select.value)?.typed;
  }

  /** @returns {ValueQuery} */
  function query() {
    const asked = options.get(select.value)?.query ?? {};
    const given = inputs.filter(({ hidden, value }) => !hidden && value.trim() !== "");
    if (given.length === 0) return asked;
    return { attribute: asked.attribute, ...Object.fromEntries(given.map(({ name, value }) => [name, value.trim()])) };
  }

  return {
    root,
    query,
    /** Fills in the attributes of the project. Returns true if the chosen one is gone. */
    fill() {
      options = new Map();
      for (const attribute of schemaOf(app)) {
        const { name, kind, of } = attribute;
        const shown = of === "frame" ? `${name} of the frame` : name;
        const values = steps(attribute);
        options.set(`${name}=`, { text: `${shown}: none`, query: { attribute: name } });
        for (const value of values ?? []) {
          const query = { attribute: name, value: String(value) };
          options.set(`${name}=${value}`, { text: `${shown}: ${nameOf(value)}`, query });
        }
        const typed = values ? undefined : kind === "text" ? "text" : "number";
        const last = { any: "any", text: "contains …", number: "from … to …" }[typed ?? "any"];
        options.set(`${name}~`, { text: `${shown}: ${last}`, query: { attribute: name, known: "true" }, typed });
      }
      root.hidden = options.size === 0;
      const isGone = refill(select, "All attributes", new Map([...options].map(([value, { text }]) => [value, text])));
      showInputs();
      return isGone;
    },
    clear() {
      select.value = "";
      showInputs();
    },
  };
}

// -- selects whose options change

/**
 * Gives a select other options; true if the chosen one is gone.
 *
 * @param {HTMLSelectElement} select
 * @param {string} all the option without a value.
 * @param {Map<string, string>} texts of the other options, by their values.
 */
export function refill(select, all, texts) {
  const chosen = select.value;
  patch(
    select,
    h("option", { value: "" }, all),
    [...texts].map(([value, text]) => h("option", { value }, text)),
  );
  select.value = texts.has(chosen) ? chosen : "";
  return select.value !== chosen;
}
