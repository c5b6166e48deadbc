/** The form of one attribute: its kind, what has it, its values, and its key. */

import { nameOf } from "../attributes.js";
import { CANCEL, openDialog } from "../dialogs.js";
import { h } from "../dom.js";
import { checkbox, field, group, partsOf, select, ticked } from "../forms.js";

/** @type {[Attribute["kind"], string][]} */
const KINDS = [
  ["choice", "One of some choices"],
  ["boolean", "Yes or no"],
  ["integer", "Whole number"],
  ["number", "Number"],
  ["text", "Free text"],
];

/** @type {[NonNullable<Attribute["of"]>, string][]} */
const OWNERS = [
  ["box", "Each box"],
  ["track", "Each object: the same value in all its frames"],
  ["frame", "Each frame"],
];

const textOf = (/** @type {string | number | boolean | undefined} */ value) => nameOf(value ?? "");

/** A default as typed; what cannot be read is left to the server, whose error says what the attribute takes. */
function readValue(/** @type {string} */ kind, /** @type {string} */ text) {
  if (text === "") return undefined;
  if (kind === "boolean" && /^(yes|no|true|false)$/i.test(text)) return /^(yes|true)$/i.test(text);
  return (kind === "integer" || kind === "number") && Number.isFinite(Number(text)) ? Number(text) : text;
}

/**
 * Asks for an attribute, a new one or another definition of a known one, and saves it.
 *
 * @param {object} options
 * @param {Attribute} [options.attribute]
 * @param {string[]} options.classes of the project.
 * @param {Attribute[]} options.attributes of the project.
 * @param {ChangeClasses} options.change
 */
export function attributeForm({ attribute, classes, attributes, change }) {
  const known = attribute;
  const input = (/** @type {string} */ testid, /** @type {Attributes} */ more) =>
    h("input", { "data-testid": testid, autocomplete: "off", ...more });
  const name = input("attribute-name", {
    value: known?.name ?? "",
    disabled: Boolean(known),
    maxlength: 64,
    autofocus: !known,
  });
  const kind = select(KINDS, { "data-testid": "attribute-kind", onchange: show }, known?.kind);
  const of = select(OWNERS, { "data-testid": "attribute-of", onchange: show }, known?.of);
  const choices = h("textarea", { rows: 4, "data-testid": "attribute-choices" });
  choices.value = (known?.choices ?? []).join("\n");
  const least = input("attribute-minimum", { type: "number", step: "any", value: textOf(known?.minimum) });
  const most = input("attribute-maximum", { type: "number", step: "any", value: textOf(known?.maximum) });
  const usual = input("attribute-default", { value: textOf(known?.default), placeholder: "none" });
  const key = input("attribute-key", { class: "key", value: known?.key ?? "", maxlength: 1, placeholder: "–" });
  const required = checkbox("attribute-required", Boolean(known?.required));
  const drop = checkbox("attribute-drop");
  const boxes = classes.map((label) =>
    checkbox(`attribute-class-${label}`, known?.classes?.includes(label), { value: label }),
  );
  const ofChoices = field("Choices, one in each line", choices);
  const limits = h("div.row", field("Smallest", least), field("Greatest", most));
  const rows = boxes.map((box) => h("label.row", box, box.value));
  const ofClasses = group("Only of these classes (none: of all)", h("div.row", rows));
  const dropping = h("label.row", { hidden: true }, drop, "Remove the values that do not fit");

  function show() {
    ofChoices.hidden = kind.value !== "choice";
    limits.hidden = kind.value !== "integer" && kind.value !== "number";
    ofClasses.hidden = of.value === "frame" || classes.length < 2;
  }

  function read() {
    const made = {
      name: name.value.trim(),
      kind: kind.value,
      of: of.value,
      choices: partsOf(ofChoices.hidden ? "" : choices.value, "\n"),
      minimum: limits.hidden ? undefined : readValue("number", least.value),
      maximum: limits.hidden ? undefined : readValue("number", most.value),
      classes: ofClasses.hidden ? [] : ticked(boxes),
      required: required.checked,
      default: readValue(kind.value, usual.value.trim()),
      key: key.value.trim().toLowerCase() || undefined,
    };
    if (!made.name) throw new Error("Please give the attribute a name.");
    if (!known && attributes.some((other) => other.name === made.name))
      throw new Error(`There is an attribute ${made.name} already. Close this form, and edit that one.`);
    return made;
  }

  show();
  return openDialog({
    title: known ? `Attribute ${known.name}` : "New attribute",
    testid: "attribute-dialog",
    content: [
      field("Name", name),
      field("Of", of),
      field("Values", kind),
      ofChoices,
      limits,
      ofClasses,
      h("div.row", field("Default", usual), field("Key, with Alt", key)),
      h("label.row", required, "Required: Checks list what has no value"),
      h("p.help", "New boxes get the default, and so do existing boxes and frames without a value."),
      dropping,
    ],
    actions: [CANCEL, { label: "Save", value: "save" }],
    async submit(value) {
      try {
        await change({ do: "attribute", attribute: read(), drop: drop.checked });
      } catch (error) {
        if (/would not fit/.test(String(error))) dropping.hidden = false;
        throw error;
      }
      return value;
    },
  });
}
