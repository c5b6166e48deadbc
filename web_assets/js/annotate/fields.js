/** The selected box as numbers: centre and size in metres, angles in degrees, class and track; and facts about it. */

import { MIN_SIZE_M, anglesDeg, copyBox, withAnglesDeg } from "../box3d.js";
import { button, count, h, leaveField, patch } from "../dom.js";
import { jumpText } from "../heading_mark.js";
import { OWN } from "./queue.js";

const ID = "The object's id in the recording";
const METRES = { unit: "m", step: 0.01, digits: 3 };
/** The numbers of a box, in groups: their fields' test ids begin with `id`; each number with its help. */
const NUMBERS = [
  {
    ...{ group: "Centre", id: "center-", ...METRES },
    help: { x: "to the right of the camera", y: "below the camera", z: "in front of the camera" },
  },
  {
    ...{ group: "Size", id: "size-", ...METRES },
    help: { length: "along the heading", width: "across the heading", height: "along the box's z axis" },
  },
  {
    ...{ group: "Rotation", id: "", unit: "°", step: 1, digits: 1 },
    help: {
      yaw: "about the scene's up direction; 0° points away from the camera",
      pitch: "a positive angle lowers the front",
      roll: "about the heading",
    },
  },
];

/** The numbers of a box by their names, degrees and metres. @returns {Record<string, number>} */
function numbersOf(/** @type {Box3D} */ box, /** @type {Vector | null} */ up) {
  const [[x, y, z], [length, width, height]] = [box.center, box.size];
  return { x, y, z, length, width, height, ...anglesDeg(box, up) };
}

/** The box with another number. @returns {Box3D} */
function withNumber(
  /** @type {Box3D} */ box,
  /** @type {Vector | null} */ up,
  /** @type {string} */ name,
  /** @type {number} */ value,
) {
  const { x, y, z, length, width, height, yaw, pitch, roll } = Object.assign(numbersOf(box, up), { [name]: value });
  if (["yaw", "pitch", "roll"].includes(name)) return withAnglesDeg(box, up, { yaw, pitch, roll });
  const size = [length, width, height].map((side) => Math.max(side, MIN_SIZE_M));
  return { ...copyBox(box), center: [x, y, z], size };
}

export function createFields(/** @type {Annotate} */ at) {
  const { app, desk } = at;
  const up = () => app.state.frame?.up ?? null;
  /** @type {Record<string, HTMLInputElement>} */
  const inputs = {};
  /** @type {Record<string, HTMLElement>} */
  const names = {};
  /** The field that is being typed in. @type {HTMLInputElement | null} */
  let typed = null;
  /** @type {string | null} */
  let shownUid = null;
  const title = h("h2.ellipsis", "Box");
  const chip = h("span.chip", { "data-testid": "label-state" });
  const facts = h("dl.facts", { "data-testid": "label-facts" });
  const why = h("p");
  const problem = h(
    "div.error-box",
    { role: "alert", hidden: true, "data-testid": "not-saved" },
    why,
    h(
      "div.row",
      button("Try again", () => void desk.retry(), { "data-testid": "draft-retry" }),
      button("Discard", () => desk.revert(), { "data-testid": "draft-discard" }),
    ),
  );
  const attributes = h("fieldset.wide", { hidden: true, "data-testid": "attributes" });
  const form = h("form.box-fields", { "data-testid": "fields" });
  const advice = h("p", { "data-testid": "box-advice" });
  const nothing = h("div.empty", advice);
  at.parts.fields.replaceChildren(h("header", title, h("span.grow"), chip), problem, form, nothing);

  /** @param {typeof NUMBERS[number]} group */
  function numberField({ id, unit, step }, /** @type {string} */ name, /** @type {string} */ help) {
    const title = `${name}: ${help}`;
    inputs[name] = typedField(
      { step, "aria-label": `${name} in ${unit}`, title, "data-testid": `field-${id}${name}` },
      (value) =>
        Number.isFinite(value) && desk.shown ? { box: withNumber(desk.shown.box, up(), name, value) } : null,
    );
    names[name] = h("span", name);
    return h("label.number-field", names[name], inputs[name], h("span.unit", unit));
  }

  /**
   * A number field. Typing changes the box on the screen; leaving the field or pressing Enter saves that as one edit.
   *
   * @param {Attributes} attributes
   * @param {(value: number) => Partial<Wanted> | null} valuesOf what a number, NaN for an empty field, changes; null:
   *     it is none.
   */
  function typedField(attributes, valuesOf) {
    /** @type {HTMLInputElement} */
    const input = h("input", {
      type: "number",
      ...attributes,
      // a click selects the old number, so that typing replaces it
      onfocus: () => input.select(),
      oninput: () => {
        typed = input;
        const values = valuesOf(input.valueAsNumber);
        if (values) desk.preview(values);
      },
      onchange: () => {
        if (!valuesOf(input.valueAsNumber)) return abandon();
        typed = null;
        void desk.commit();
      },
      onkeydown: (event) => {
        if (event.key !== "Escape") return;
        event.preventDefault();
        abandon();
      },
    });
    return input;
  }

  /** Shows the box as it was before something was typed. */
  function abandon() {
    typed = null;
    if (desk.hasDraft) desk.revert();
    else show();
  }

  const choice = h("select", {
    "aria-label": "Class",
    "data-testid": "field-class",
    onchange: () => {
      // so that Space and the digits are keys of the mode again
      choice.blur();
      void desk.edit({ label: choice.value });
    },
  });
  const track = typedField(
    { step: 1, min: 0, placeholder: "none", "aria-label": "Track id", title: ID, "data-testid": "field-track" },
    (value) => ({ track_id: Number.isInteger(value) ? value : null }),
  );
  /** @type {HTMLElement[]} */
  const ofBox = [
    h(
      "fieldset.wide",
      h("label.number-field", h("span", "Class"), choice),
      h("label.number-field", h("span", "Track"), track),
    ),
    ...NUMBERS.map((each) => {
      const all = Object.entries(each.help).map(([name, help]) => numberField(each, name, help));
      return h("fieldset", h("legend", each.group), all);
    }),
  ];
  form.append(...ofBox, attributes, facts);
  ofBox.push(facts);
  form.addEventListener("submit", (event) => event.preventDefault());
  desk.onLeave(() => leaveField(form));

  /** Shows a number, but not in the field that is being typed in. */
  function put(/** @type {string} */ name, /** @type {number} */ value, /** @type {number} */ digits) {
    // -0.0 is 0
    const text = value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1");
    if (inputs[name] !== typed && inputs[name].value !== text) inputs[name].value = text;
  }

  function show() {
    const label = desk.shown;
    if (desk.uid !== shownUid) [shownUid, typed] = [desk.uid, null];
    // attributes of the frame are shown without a box, too
    for (const part of ofBox) part.hidden = !label;
    chip.hidden = !label;
    nothing.hidden = Boolean(label);
    title.textContent = label ? label.label : "Box";
    problem.hidden = !desk.problemOf();
    why.textContent = `Not saved. ${desk.problemOf()}`;
    // where something is drawn or dashed already, what to do with that comes first
    advice.textContent =
      at.teach.hint() ||
      (desk.labels().length
        ? "No box is selected. Press Tab for the next one, or click a box on the image or in the 3D view."
        : "No box is here yet. Drag one around an object on the image, and take it with Space.");
    if (!label) return;
    const state = desk.hasDraft ? "not saved" : label.isNew ? "new" : label.state;
    chip.textContent = state;
    chip.className = `chip state-${label.state}`;
    const numbers = numbersOf(label.box, up());
    for (const { help, digits } of NUMBERS) for (const name of Object.keys(help)) put(name, numbers[name], digits);
    const jump = jumpText(label);
    names.yaw.textContent = jump || "yaw";
    names.yaw.className = jump ? "bad" : "";
    const classes = new Set([...app.state.project.classes, label.label]);
    patch(
      choice,
      [...classes].map((name) => h("option", { value: name }, name)),
    );
    choice.value = label.label;
    if (typed !== track) track.value = String(label.track_id ?? "");
    patch(facts, describe(label));
  }

  return { show, attributes };
}

const percent = (/** @type {number | null | undefined} */ value) =>
  value === null || value === undefined ? "–" : `${(100 * value).toFixed(0)} %`;

/** The same facts of every box, in the same places; what only some boxes have comes after them. */
function describe(/** @type {PageLabel} */ label) {
  const { quality, measured_by: measured, suggestion } = label;
  const rows = [
    ["Points", label.points.toLocaleString("en"), "in the stored box"],
    ["Score", label.score === null ? "–" : label.score.toFixed(2), scorer(label)],
    ["Created by", label.source === "auto" ? "proposal" : label.source, "who created the box"],
    ["Changed by", label.author, "who changed it last"],
    [
      "Doubt",
      percent(label.doubt),
      `sets the 'Most doubtful first' order of the queue. The views differ by ${percent(quality?.view_disagreement)} ` +
        `of the box's size; ${percent(quality?.kept_share)} of the last view's points are in the box; the last ` +
        `measurement changed it by ${percent(quality?.last_change)}`,
    ],
    [
      "May be off by",
      percent(quality?.expected_iou_loss),
      "expected 1 - IoU with the true box, from how well the views fit",
    ],
  ];
  const facts = rows.map(([name, value, help]) =>
    h("div", { title: `${name}: ${value}, ${help}` }, h("dt", name), h("dd.number.ellipsis", value)),
  );
  const wide = [];
  if (measured) wide.push(["Measured by", measured]);
  if (suggestion)
    wide.push(["Suggested by", `${suggestion.detector}${suggestion.corrected ? " (partly drawn or corrected)" : ""}`]);
  if (label.kept) wide.push(["Stays", "until it is reviewed: attributes were set by hand"]);
  if (label.said.length) wide.push(["Said by", label.said.map(words).join(", ")]);
  return [...facts, ...wide.map(([name, who]) => h("div.wide", h("dt", name), h("dd", who)))];
}

/** Whose score a label has: of several sources, that of the shown box. */
function scorer(/** @type {PageLabel} */ { score, source, said }) {
  const by = said.find((each) => each.score === score)?.source;
  if (by !== undefined && by !== OWN) return `of ${by}`;
  return by === undefined && source === "imported" ? "as in the imported file" : "of both detectors together";
}

/** What one source says of an object, such as "mine: car 0.82". */
function words(/** @type {Api.SaidJson} */ { source, label, score }) {
  return `${source}: ${label}${score === null ? "" : ` ${score.toFixed(2)}`}`;
}

/** The counts of labels by state, such as "3 proposed, 1 accepted". */
export function summary(/** @type {PageLabel[]} */ labels) {
  const states = ["proposed", "accepted", "edited", "rejected"];
  const parts = states.flatMap((state) => {
    const number = labels.filter((label) => label.state === state).length;
    return number > 0 ? [`${number} ${state}`] : [];
  });
  return parts.length ? parts.join(", ") : count(0, "box", "boxes");
}
