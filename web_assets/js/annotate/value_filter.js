/** The filter of the queue by the values of an attribute: of boxes, of tracks, or of frames. */

import { nameOf, schemaOf, steps } from "../attributes.js";
import { h, patch } from "../dom.js";

/** `onChange` is called with what the server is to be asked. */
export function createValueFilter(
  /** @type {ModeApp} */ app,
  /** @type {(query: import("./queue.js").ValueQuery) => unknown} */ onChange,
) {
  /** The attribute of each option that is typed, by the option's value. @type {Map<string, Attribute>} */
  let typed = new Map();
  /** What each option asks, by its value. @type {Map<string, import("./queue.js").ValueQuery>} */
  let queries = new Map();
  /** @type {HTMLSelectElement} */
  const select = h("select", {
    "aria-label": "Attribute in the queue",
    "data-testid": "queue-attribute",
    onchange: choose,
  });
  const low = input("low", "from", "number");
  const high = input("high", "to", "number");
  const contains = input("contains", "contains", "text");
  const root = h("span.value-filter", select, low, high, contains);

  /** @returns {HTMLInputElement} */
  function input(
    /** @type {string} */ name,
    /** @type {string} */ placeholder,
    /** @type {"number" | "text"} */ type,
  ) {
    return h("input", {
      type,
      step: type === "number" ? "any" : null,
      placeholder,
      hidden: true,
      "aria-label": `Attribute in the queue, ${placeholder}`,
      "data-testid": `queue-${name}`,
      onchange: () => onChange(query()),
    });
  }

  function choose() {
    const attribute = typed.get(select.value);
    for (const each of [low, high, contains]) each.value = "";
    showInputs();
    if (!attribute) select.blur();
    else if (attribute.kind === "text") contains.focus();
    else low.focus();
    onChange(query());
  }

  function showInputs() {
    const attribute = typed.get(select.value);
    low.hidden = high.hidden = !attribute || attribute.kind === "text";
    contains.hidden = attribute?.kind !== "text";
  }

  /** @returns {import("./queue.js").ValueQuery} */
  function query() {
    const attribute = typed.get(select.value);
    if (!attribute) return queries.get(select.value) ?? {};
    // the kind of the attribute may have changed since something was typed
    const asked = Object.entries(
      attribute.kind === "text" ? { contains: contains.value.trim() } : { low: low.value, high: high.value },
    );
    const given = asked.filter(([, text]) => text !== "");
    return { attribute: attribute.name, ...(given.length > 0 ? Object.fromEntries(given) : { known: "true" }) };
  }

  return {
    root,
    query,
    /** Fills in the attributes of the project. Returns true if the chosen one is gone. */
    fill() {
      /** @type {Map<string, string>} */
      const texts = new Map();
      typed = new Map();
      queries = new Map();
      for (const attribute of schemaOf(app)) {
        const { name, kind, of } = attribute;
        const shown = of === "frame" ? `${name} of the frame` : name;
        const values = steps(attribute);
        texts.set(`${name}=`, `${shown}: none`);
        queries.set(`${name}=`, { attribute: name });
        for (const value of values ?? []) {
          texts.set(`${name}=${value}`, `${shown}: ${nameOf(value)}`);
          queries.set(`${name}=${value}`, { attribute: name, value: String(value) });
        }
        const last = `${name}~`;
        const typedIn = kind === "text" ? "contains …" : "from … to …";
        texts.set(last, `${shown}: ${values ? "any" : typedIn}`);
        if (values) queries.set(last, { attribute: name, known: "true" });
        else typed.set(last, attribute);
      }
      root.hidden = texts.size === 0;
      const isGone = refill(select, "All attributes", texts);
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
