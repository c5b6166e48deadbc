/** The selected box as numbers: centre and size in metres, yaw, pitch and roll in degrees, class and track; and what is known of it. */

import { MIN_SIZE_M, anglesDeg, copyBox, withAnglesDeg } from "../box3d.js";
import { count, h } from "../dom.js";

const CENTER = [["x", "to the right of the camera"], ["y", "below the camera"], ["z", "in front of the camera"]];
const SIZE = [["length", "along the heading"], ["width", "across the heading"], ["height", "along the box's own up"]];
const ANGLES = [
  ["yaw", "about the scene's up; 0° is away from the camera"],
  ["pitch", "front end down"],
  ["roll", "about the heading"],
];

export function createFields(host, desk, { classes, up }) {
  const inputs = {};
  let typed = null;
  let shown_uid = null;
  const title = h("h2", { class: "ellipsis" });
  const chip = h("span", { class: "chip", "data-testid": "label-state" });
  const facts = h("dl", { class: "facts", "data-testid": "label-facts" });
  const problem = h("div", { class: "error-box", role: "alert", hidden: true, "data-testid": "not-saved" });
  const form = h("form", { class: "box-fields", "data-testid": "fields" });
  const nothing = h("div", { class: "empty" }, h("p", {}, "No box is selected. Tab goes to the next one; a click on the image or in the 3D view selects."));
  host.replaceChildren(h("header", {}, title, h("span", { class: "grow" }), chip), problem, form, nothing);

  function number(name, label, help, unit, step, change) {
    const input = h("input", {
      type: "number", step, "aria-label": `${label} in ${unit}`, title: `${label}: ${help}`, "data-testid": `field-${name}`,
      oninput: () => {
        typed = input;
        if (Number.isFinite(input.valueAsNumber)) change(input.valueAsNumber);
      },
      onchange: () => leave(input),
      onkeydown: (event) => {
        if (event.key !== "Escape") return;
        event.preventDefault();
        typed = null;
        desk.revert();
      },
    });
    inputs[name] = input;
    return h("label", { class: "number-field" }, h("span", {}, label), input, h("span", { class: "unit" }, unit));
  }

  // What is half typed is shown by the box, and saved when the field is left or Enter is pressed: one edit.
  function leave(input) {
    typed = null;
    if (!Number.isFinite(input.valueAsNumber)) desk.revert();
    else void desk.commit();
  }

  const box = () => copyBox(desk.shown.box);
  const setBox = (change) => desk.shown && desk.preview({ box: change(box()) });
  const place = (list, i, value) => list.map((old, k) => (k === i ? value : old));
  const angles = () => anglesDeg(desk.shown.box, up());

  const choice = h(
    "select",
    { "aria-label": "Class", "data-testid": "field-class", onchange: () => {
      // Space and the digits are keys of the mode again
      choice.blur();
      void desk.edit({ label: choice.value });
    } },
    classes().map((name) => h("option", { value: name }, name)),
  );
  const track = h("input", {
    type: "number", step: 1, min: 0, placeholder: "none", "aria-label": "Track id", title: "The object's id over the recording", "data-testid": "field-track",
    oninput: () => desk.shown && desk.preview({ track_id: Number.isInteger(track.valueAsNumber) ? track.valueAsNumber : null }),
    onchange: () => void desk.commit(),
  });
  form.append(
    h("fieldset", { class: "wide" }, h("label", { class: "number-field" }, h("span", {}, "Class"), choice), h("label", { class: "number-field" }, h("span", {}, "Track"), track)),
    group("Centre", CENTER.map(([name, help], i) => number(`center-${name}`, name, help, "m", 0.01, (value) => setBox((old) => ({ ...old, center: place(old.center, i, value) }))))),
    group("Size", SIZE.map(([name, help], i) => number(`size-${name}`, name, help, "m", 0.01, (value) => setBox((old) => ({ ...old, size: place(old.size, i, Math.max(value, MIN_SIZE_M)) }))))),
    group("Rotation", ANGLES.map(([name, help]) => number(name, name, help, "°", 1, (value) => setBox((old) => withAnglesDeg(old, up(), { ...angles(), [name]: value }))))),
    facts,
  );
  form.addEventListener("submit", (event) => event.preventDefault());

  /** Writes a number, but not into the field that is being typed in. */
  function put(name, value, digits) {
    // -0.0 is 0
    const text = value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1");
    if (inputs[name] !== typed && inputs[name].value !== text) inputs[name].value = text;
  }

  function showProblem() {
    const why = desk.problemOf();
    problem.hidden = !why;
    if (!why) return;
    problem.replaceChildren(
      h("p", {}, `Not saved. ${why}`),
      h("div", { class: "row" }, h("button", { type: "button", onclick: () => void desk.retry(), "data-testid": "draft-retry" }, "Try again"), h("button", { type: "button", onclick: () => desk.revert(), "data-testid": "draft-discard" }, "Discard")),
    );
  }

  function show() {
    const label = desk.shown;
    if (desk.uid !== shown_uid) [shown_uid, typed] = [desk.uid, null];
    form.hidden = !label;
    chip.hidden = !label;
    nothing.hidden = Boolean(label);
    title.textContent = label ? label.label : "Box";
    showProblem();
    if (!label) return;
    const state = desk.hasDraft ? "not saved" : label.is_new ? "new" : label.state;
    chip.textContent = state;
    chip.className = `chip state-${label.state}`;
    const turn = anglesDeg(label.box, up());
    label.box.center.forEach((value, i) => put(`center-${CENTER[i][0]}`, value, 3));
    label.box.size.forEach((value, i) => put(`size-${SIZE[i][0]}`, value, 3));
    for (const [name] of ANGLES) put(name, turn[name], 1);
    if (![...choice.options].some(({ value }) => value === label.label)) choice.append(h("option", { value: label.label }, label.label));
    choice.value = label.label;
    if (document.activeElement !== track) track.value = label.track_id ?? "";
    facts.replaceChildren(...describe(label));
  }

  return { show };
}

function group(name, fields) {
  return h("fieldset", {}, h("legend", {}, name), fields);
}

const percent = (value) => (value === null || value === undefined ? "–" : `${(100 * value).toFixed(0)} %`);

function describe(label) {
  const rows = [
    ["Points", label.points.toLocaleString("en"), "in the box as it is stored"],
    ["Score", label.score === null ? "–" : label.score.toFixed(2), "of both detectors"],
    ["Made by", label.source === "auto" ? "proposal" : label.source, "who made the box first"],
    ["Last by", label.author, "who changed it last"],
  ];
  if (label.doubt !== null) rows.push(["Doubt", percent(label.doubt), "the queue's worst-first order goes by it"]);
  if (label.quality) {
    rows.push(["Disagree", percent(label.quality.view_disagreement), "difference of what the views measured, as a share of the box's size"]);
    rows.push(["Kept", percent(label.quality.kept_share), "share of the last view's points that the box kept"]);
    rows.push(["Last step", percent(label.quality.last_change), "how much the last step still changed the box"]);
  }
  return rows.map(([name, value, help]) => h("div", { title: `${name}: ${help}` }, h("dt", {}, name), h("dd", { class: "number ellipsis" }, value)));
}

/** "3 proposed, 1 accepted" of a list of labels. */
export function summary(labels) {
  const states = ["proposed", "accepted", "edited", "rejected"];
  const parts = states.map((state) => [state, labels.filter((label) => label.state === state).length]).filter(([, n]) => n > 0);
  return parts.length ? parts.map(([state, n]) => `${n} ${state}`).join(", ") : count(0, "box", "boxes");
}
