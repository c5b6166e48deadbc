/** What is asked for before an export: format, states, classes, recordings, and how the frames are divided. */

import { count, h } from "../dom.js";

const STATES = [
  ["accepted", "accepted"],
  ["edited", "edited"],
  ["proposed", "proposed, not reviewed"],
  ["rejected", "rejected"],
];
/** Boxes that nobody has reviewed leave only where somebody says so. */
const USUAL = new Set(["accepted", "edited"]);
const PICTURES = [["images", "camera images"], ["views", "pseudo-views"], ["both", "both"]];

const options = (rows) => rows.map(([value, text]) => h("option", { value }, text));
const ticked = (boxes) => boxes.filter((box) => box.checked).map((box) => box.value);

/**
 * @param {object[]} formats as /api/export-formats tells them.
 * @param {() => void} onChange
 * @returns {{parts: Node[], request: () => object, isFlat: () => boolean, total: () => number, chosen: () => number,
 *     show: () => void}} `request` throws where nothing is chosen; `isFlat`: the format holds 2D boxes, which need no label;
 *     `total` and `chosen` count boxes of the project.
 */
export function createExportForm(app, formats, onChange) {
  const { classes, recordings } = app.state.project;
  const check = (value, checked, testid) => h("input", { type: "checkbox", value, checked, onchange: onChange, "data-testid": testid });
  const states = STATES.map(([state]) => check(state, USUAL.has(state), `export-state-${state}`));
  const counts = STATES.map(() => h("span", { class: "muted number" }));
  const of_classes = classes.map((name) => check(name, true));
  const of_recordings = recordings.map(({ id, name }) => check(String(id), true, `export-recording-${name}`));
  const format = h("select", { "data-testid": "export-format", onchange: onChange }, options(formats.map(({ name, summary }) => [name, `${name}: ${summary}`])));
  const pictures = h("select", { "data-testid": "export-pictures" }, options(PICTURES));
  const pictures_field = h("label", { class: "field" }, h("span", {}, "2D boxes on"), pictures);
  const skip = check("skip", false, "export-skip-unreadable");
  const divide = check("divide", false, "export-divide");
  const shares = h("input", { value: "train=0.8,val=0.2", "aria-label": "Parts and their shares", "data-testid": "export-shares" });
  const by = h("select", { "aria-label": "What is not divided", "data-testid": "export-split-by" }, options([["frames", "by frames"], ["recordings", "by whole recordings"]]));
  const seed = h("input", { type: "number", value: 0, min: 0, "aria-label": "Seed of the drawing", class: "number", "data-testid": "export-seed" });
  const division = h("div", { class: "row", hidden: true }, shares, by, "seed", seed);

  const group = (legend, rows) => h("fieldset", { class: "plain" }, h("legend", { class: "field-label" }, legend), rows);
  const several = (legend, boxes, names) => (boxes.length > 1 ? group(legend, h("div", { class: "choices-list" }, boxes.map((box, i) => h("label", { class: "row" }, box, names[i])))) : null);

  const countOf = (state) => app.state.project?.labels_by_state[state] ?? 0;
  const isFlat = () => Boolean(formats.find(({ name }) => name === format.value)?.flat);
  const all = (boxes) => (boxes.every((box) => box.checked) ? null : ticked(boxes));

  return {
    parts: [
      group("Boxes", STATES.map(([, text], i) => h("label", { class: "row" }, states[i], text, counts[i]))),
      several("Classes", of_classes, classes),
      several("Recordings", of_recordings, recordings.map(({ name }) => name)),
      h("label", { class: "field" }, h("span", {}, "Format"), format),
      pictures_field,
      group("Parts", [h("label", { class: "row" }, divide, "Divide the frames into parts"), division]),
      group("Damaged files", [h("label", { class: "row" }, skip, "Leave out frames that cannot be read")]),
    ].filter(Boolean),

    request() {
      if (!ticked(states).length || !ticked(of_classes).length || !ticked(of_recordings).length) throw new Error("Choose at least one state, one class and one recording.");
      return {
        kind: "export",
        format: format.value,
        states: ticked(states),
        classes: all(of_classes),
        recordings: all(of_recordings)?.map(Number) ?? null,
        pictures: pictures.value,
        skip_unreadable: skip.checked,
        split: divide.checked ? { shares: shares.value, by: by.value, seed: Number(seed.value) || 0 } : null,
      };
    },

    isFlat,
    total: () => STATES.reduce((sum, [state]) => sum + (state === "rejected" ? 0 : countOf(state)), 0),
    chosen: () => ticked(states).reduce((sum, state) => sum + countOf(state), 0),

    show() {
      counts.forEach((span, i) => (span.textContent = count(countOf(STATES[i][0]), "box", "boxes")));
      pictures_field.hidden = !isFlat();
      division.hidden = !divide.checked;
    },
  };
}
