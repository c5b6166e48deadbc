/** The form of an export: format, states, classes, recordings, and the division of the frames into parts. */

import { count, h } from "../dom.js";
import { checkbox, field, group, numberField, remembered, select, ticked } from "../forms.js";

const STATES = [
  ["accepted", "accepted"],
  ["edited", "edited"],
  ["proposed", "proposed, not reviewed"],
  ["rejected", "rejected"],
];
/** The states that are chosen initially: reviewed boxes only. */
const USUAL = new Set(["accepted", "edited"]);
const PICTURES = [
  ["images", "camera images"],
  ["views", "pseudo-views"],
  ["both", "both"],
];
const DIVISIONS = [
  ["frames", "by frames"],
  ["recordings", "by whole recordings"],
];

export function createExportForm(
  /** @type {ModeApp} */ app,
  /** @type {Api.FormatInfo[]} */ formats,
  /** @type {() => void} */ onChange,
) {
  const { classes, recordings } = app.state.project;
  const check = (
    /** @type {string} */ value,
    /** @type {boolean} */ checked,
    /** @type {string | null} */ testid = null,
  ) => checkbox(testid === null ? null : `export-${testid}`, checked, { value, onchange: onChange });
  const states = STATES.map(([state]) => check(state, USUAL.has(state), `state-${state}`));
  const counts = STATES.map(() => h("span.muted.number"));
  const ofClasses = classes.map((name) => check(name, true));
  const ofRecordings = recordings.map(({ id, name }) => check(String(id), true, `recording-${name}`));
  const known = formats.map(({ name, summary }) => [name, `${name}: ${summary}`]);
  const format = remembered(
    app,
    "export",
    "format",
    select(known, { "data-testid": "export-format", onchange: onChange }),
  );
  const pictures = select(PICTURES, { "data-testid": "export-pictures" });
  const picturesField = field("2D boxes on", pictures);
  const skip = check("skip", false, "skip-unreadable");
  const divide = check("divide", false, "divide");
  const shares = remembered(
    app,
    "export",
    "shares",
    h("input", {
      value: "train=0.8,val=0.2",
      "aria-label": "Parts and their shares",
      "data-testid": "export-shares",
    }),
  );
  const by = select(DIVISIONS, { "aria-label": "Split by", "data-testid": "export-split-by" });
  const seed = numberField("export-seed", "Random seed", { class: "number", value: 0, min: 0 });
  const division = h("div.row", { hidden: true }, shares, by, "seed", seed);

  const several = (
    /** @type {string} */ legend,
    /** @type {HTMLInputElement[]} */ boxes,
    /** @type {string[]} */ names,
  ) => {
    const rows = boxes.map((box, i) => h("label.row", box, names[i]));
    return boxes.length > 1 && group(legend, h("div.choices-list", rows));
  };

  const countOf = (/** @type {string} */ state) => app.state.project?.labels_by_state[state] ?? 0;
  const isFlat = () => Boolean(formats.find(({ name }) => name === format.value)?.flat);
  const all = (/** @type {HTMLInputElement[]} */ boxes) => (boxes.every((box) => box.checked) ? null : ticked(boxes));

  return {
    parts: [
      group(
        "Boxes",
        STATES.map(([, text], i) => h("label.row", states[i], text, counts[i])),
      ),
      several("Classes", ofClasses, classes),
      several(
        "Recordings",
        ofRecordings,
        recordings.map(({ name }) => name),
      ),
      field("Format", format),
      picturesField,
      group("Parts", h("label.row", divide, "Split the frames into parts"), division),
      group("Damaged files", h("label.row", skip, "Leave out frames that cannot be read")),
    ],

    /**
     * @returns {Api.ExportRequest}
     * @throws {Error} nothing is chosen.
     */
    request() {
      if (!ticked(states).length || !ticked(ofClasses).length || !ticked(ofRecordings).length)
        throw new Error("Choose at least one state, one class and one recording.");
      return {
        kind: "export",
        format: /** @type {Api.ExportFormat} */ (format.value),
        states: /** @type {Api.ReviewState[]} */ (ticked(states)),
        classes: all(ofClasses),
        recordings: all(ofRecordings)?.map(Number) ?? null,
        pictures: /** @type {Api.ExportRequest["pictures"]} */ (pictures.value),
        skip_unreadable: skip.checked,
        split: divide.checked
          ? {
              shares: shares.value,
              by: by.value === "recordings" ? "recordings" : "frames",
              seed: Number(seed.value) || 0,
            }
          : null,
      };
    },

    /** Whether the format has 2D boxes; these can be exported without 3D labels. */
    isFlat,
    /** The number of the project's boxes, without rejected ones. */
    total: () => STATES.reduce((sum, [state]) => sum + (state === "rejected" ? 0 : countOf(state)), 0),
    chosen: () => ticked(states).reduce((sum, state) => sum + countOf(state), 0),

    show() {
      counts.forEach((span, i) => {
        span.textContent = count(countOf(STATES[i][0]), "box", "boxes");
      });
      picturesField.hidden = !isFlat();
      division.hidden = !divide.checked;
    },
  };
}
