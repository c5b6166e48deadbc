/** The attributes of the selected box, of its track and of the frame: a field for each, and the keys for them. */

import { h, leaveField } from "./dom.js";
import { select } from "./forms.js";

/** An integer attribute with more values is typed, not chosen. */
const MOST_STEPS = 20;

/**
 * The values that a key goes through; null for an attribute that is typed.
 *
 * @returns {(string | number | boolean)[] | null}
 */
export function steps(/** @type {Attribute} */ { kind, choices, minimum, maximum }) {
  if (kind === "choice") return choices ?? [];
  if (kind === "boolean") return [true, false];
  if (kind !== "integer" || minimum === undefined || maximum === undefined || maximum - minimum >= MOST_STEPS)
    return null;
  const first = Math.ceil(minimum);
  return Array.from({ length: Math.floor(maximum) - first + 1 }, (_, n) => first + n);
}

/** @returns {Attribute[]} */
export const schemaOf = (/** @type {App} */ app) =>
  /** @type {Attribute[]} */ (/** @type {unknown} */ (app.state.project?.attributes ?? []));

/** A value as the operator reads it. */
export const nameOf = (/** @type {string | number | boolean} */ value) =>
  value === true ? "yes" : value === false ? "no" : String(value);

/** The values of a box in one line, in the order of the project's attributes, such as "pose=sitting, mass=80". */
export const valuesText = (
  /** @type {App} */ app,
  /** @type {{ attributes?: Record<string, string | number | boolean> }} */ { attributes = {} },
) =>
  schemaOf(app)
    .filter(({ name, of }) => of !== "frame" && attributes[name] !== undefined)
    .map(({ name }) => `${name}=${nameOf(attributes[name])}`)
    .join(", ");

/**
 * @param {HTMLElement} host
 * @param {ModeApp} app
 * @param {object} target what has the values.
 * @param {() => AttributeOwner | null} target.shown the selected box.
 * @param {(uid: string | null, values: Record<string, string | number | boolean | null>) => unknown} target.set sets
 *     values of a box, or (null) of the frame.
 * @param {(name: string) => unknown} target.setClass false if there is nothing to give the class to.
 * @param {() => boolean} [target.isReadonly]
 */
export function createAttributes(host, app, target) {
  /** @type {Map<string, HTMLSelectElement | HTMLInputElement>} */
  const fields = new Map();
  let shown = "";
  /** The uid of the box whose values are shown. @type {string | null} */
  let owner = null;
  /** The field that is being typed in. @type {HTMLInputElement | null} */
  let typed = null;

  /** The attributes of the selected box and of the frame. */
  function present() {
    const label = target.shown();
    return schemaOf(app).filter(({ of, classes }) =>
      of === "frame"
        ? app.state.frame !== null
        : label !== null && !label.isNew && (!classes?.length || classes.includes(label.label)),
    );
  }

  function current(/** @type {Attribute} */ { name, of, default: usual }) {
    if (of !== "frame") return target.shown()?.attributes?.[name];
    return app.state.frame?.frame.attributes[name] ?? usual;
  }

  function set(/** @type {Attribute} */ { name, of }, /** @type {string | number | boolean | null} */ value) {
    if (of === "frame" || owner !== null) void target.set(of === "frame" ? null : owner, { [name]: value });
  }

  function field(/** @type {Attribute} */ attribute) {
    const { name, kind, key, of, required, minimum, maximum } = attribute;
    const values = steps(attribute);
    const common = {
      "aria-label": name,
      "data-testid": `attribute-${name}`,
      title: `${name}${of && of !== "box" ? ` of the ${of}` : ""}${required ? ", required" : ""}`,
    };
    /** @type {HTMLSelectElement | HTMLInputElement} */
    let input;
    if (values) {
      const rows = values.map((value, index) => [String(index), nameOf(value)]);
      const onchange = () => {
        const index = Number(input.value);
        input.blur();
        set(attribute, input.value === "" ? null : values[index]);
      };
      input = select([["", "–"], ...rows], { ...common, onchange });
    } else {
      const range = { type: "number", step: kind === "integer" ? 1 : "any", min: minimum, max: maximum };
      input = typedField(attribute, { ...common, ...(kind === "text" ? { type: "text", maxlength: 1000 } : range) });
    }
    fields.set(name, input);
    return h(
      "label.number-field",
      h("span", name, required ? " *" : "", key ? " " : "", key ? h("kbd", `Alt ${key.toUpperCase()}`) : ""),
      input,
    );
  }

  /** A field whose value counts when it is left, and not if Escape is pressed. */
  function typedField(/** @type {Attribute} */ attribute, /** @type {Attributes} */ more) {
    /** @type {HTMLInputElement} */
    const own = h("input", {
      ...more,
      oninput: () => {
        typed = own;
      },
      onchange: () => {
        if (typed !== own) return;
        typed = null;
        // such as "1e"
        if (own.validity.badInput) return show();
        const value = own.type === "text" ? own.value : own.valueAsNumber;
        set(attribute, value === "" || Number.isNaN(value) ? null : value);
      },
      onkeydown: (event) => {
        if (event.key !== "Escape") return;
        event.preventDefault();
        typed = null;
        show();
      },
    });
    return own;
  }

  function show() {
    const attributes = present();
    const uid = target.shown()?.uid ?? null;
    const signature = JSON.stringify(attributes);
    // what was typed belongs to the box that was shown
    if (uid !== owner || signature !== shown) leaveField(host);
    owner = uid;
    if (signature !== shown) {
      shown = signature;
      fields.clear();
      host.replaceChildren(h("legend", "Attributes"), ...attributes.map(field));
      host.hidden = attributes.length === 0;
    }
    for (const attribute of attributes) {
      const input = fields.get(attribute.name);
      if (!input || input === typed) continue;
      input.disabled = Boolean(target.isReadonly?.());
      const value = current(attribute);
      const values = steps(attribute);
      if (value === undefined) input.value = "";
      else input.value = String(values ? values.indexOf(value) : value);
    }
  }

  return {
    show,

    /**
     * Sets the next value of the attribute whose key it is, or the class; false if no attribute or class has the key.
     *
     * @param {string} name of the key, with Alt
     */
    press(name) {
      if (target.isReadonly?.()) return false;
      const key = name.replace(/^Alt\+/, "").toLowerCase();
      const attribute = present().find((each) => each.key === key);
      if (!attribute) {
        const styles = /** @type {Record<string, { key?: string }>} */ (app.state.project.class_styles);
        const label = Object.keys(styles).find((each) => styles[each].key === key);
        return label !== undefined && target.setClass(label) !== false;
      }
      const values = steps(attribute);
      if (!values) {
        fields.get(attribute.name)?.focus();
        return true;
      }
      const value = current(attribute);
      set(attribute, values[((value === undefined ? -1 : values.indexOf(value)) + 1) % values.length]);
      return true;
    },
  };
}
