/** Export: which boxes, in which format; then the download, with a list of what the format cannot store. */

import { bullets, count, dateOf, h, nothing, patch } from "../dom.js";
import { checkbox, errorBox, field, group, numberField, remembered, select, ticked } from "../forms.js";
import { createJobForm, createJobLine, isActive, jobsOf, latestJob } from "../jobs.js";
import { makeHash } from "../router.js";

/** What is chosen at first: reviewed boxes only. @type {[Api.ReviewState, string, boolean][]} */
const STATES = [
  ["accepted", "accepted", true],
  ["edited", "edited", true],
  ["proposed", "proposed, not reviewed", false],
  ["rejected", "rejected", false],
];
const PICTURES = [
  ["images", "camera images"],
  ["views", "pseudo-views"],
  ["both", "both"],
];
const DIVISIONS = [
  ["frames", "by frames"],
  ["recordings", "by whole recordings"],
];

/** 3400000 -> "3.4 MB, " */
const size = (/** @type {number | undefined} */ bytes) =>
  bytes ? `${(bytes / 1e6).toLocaleString("en", { maximumFractionDigits: 1 })} MB, ` : "";

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  const body = h("div.body.stack");
  root.append(h("div.page", h("h1", "Export"), h("section.panel", h("header", h("h2", "Make a dataset")), body)));
  begin(app, body, until).catch((error) => body.replaceChildren(errorBox(error)));
}

async function begin(/** @type {ModeApp} */ app, /** @type {HTMLElement} */ body, /** @type {AbortSignal} */ until) {
  const [formats, { material }] = await Promise.all([
    app.api.get("/api/export-formats"),
    app.api.get(app.path("models")),
  ]);
  if (until.aborted) return;
  const { classes, recordings } = app.state.project;
  const states = STATES.map(([value, , checked]) => checkbox(`export-state-${value}`, checked, { value }));
  const counts = STATES.map(() => h("span.muted.number"));
  const ofClasses = classes.map((value) => checkbox(null, true, { value }));
  const ofRecordings = recordings.map(({ id, name }) => checkbox(`export-recording-${name}`, true, { value: id }));
  const known = formats.map(({ name, summary }) => [name, `${name}: ${summary}`]);
  const format = remembered(app, "export", "format", select(known, { "data-testid": "export-format" }));
  const pictures = select(PICTURES, { "data-testid": "export-pictures" });
  const picturesField = field("2D boxes on", pictures);
  const skip = checkbox("export-skip-unreadable");
  const divide = checkbox("export-divide");
  const words = { "aria-label": "Parts and their shares", "data-testid": "export-shares" };
  const shares = remembered(app, "export", "shares", h("input", { value: "train=0.8,val=0.2", ...words }));
  const by = select(DIVISIONS, { "aria-label": "Split by", "data-testid": "export-split-by" });
  const seed = numberField("export-seed", "Random seed", { class: "number", value: 0, min: 0 });
  const division = h("div.row", { hidden: true }, shares, by, "seed", seed);
  const note = h("span.help", { "data-testid": "export-note" });
  const several = (
    /** @type {string} */ legend,
    /** @type {HTMLInputElement[]} */ boxes,
    /** @type {string[]} */ names,
  ) => {
    const rows = boxes.map((box, i) => h("label.row", box, names[i]));
    return boxes.length > 1 && group(legend, h("div.choices-list", rows));
  };
  const ofStates = STATES.map(([, text], i) => h("label.row", states[i], text, counts[i]));
  const names = recordings.map(({ name }) => name);
  const { form, start } = createJobForm(app, {
    name: "export",
    label: "Export",
    content: (start) => [
      group("Boxes", ofStates),
      several("Classes", ofClasses, classes),
      several("Recordings", ofRecordings, names),
      field("Format", format),
      picturesField,
      group("Parts", h("label.row", divide, "Split the frames into parts"), division),
      group("Damaged files", h("label.row", skip, "Leave out frames that cannot be read")),
      h("div.row", start, note),
    ],
    request,
    show,
  });
  form.classList.add("choices-of-export");
  form.addEventListener("change", show);
  const line = createJobLine(app, "export");
  const result = h("div.stack", { "data-testid": "export-result" });
  const text = "No boxes are accepted yet. Review proposals, or label objects, first.";
  const empty = nothing("", text, makeHash(app.state.route.project, "annotate"), "Annotate");
  body.replaceChildren(empty, form, line, result);

  /** @returns {Api.ExportRequest} */
  function request() {
    if (!ticked(states).length || !ticked(ofClasses).length || !ticked(ofRecordings).length)
      throw new Error("Choose at least one state, one class and one recording.");
    const all = (/** @type {HTMLInputElement[]} */ boxes) =>
      boxes.every((box) => box.checked) ? null : ticked(boxes);
    const split = {
      shares: shares.value,
      by: /** @type {"frames" | "recordings"} */ (by.value),
      seed: Number(seed.value) || 0,
    };
    return {
      kind: "export",
      format: /** @type {Api.ExportFormat} */ (format.value),
      states: /** @type {Api.ReviewState[]} */ (ticked(states)),
      classes: all(ofClasses),
      recordings: all(ofRecordings)?.map(Number) ?? null,
      pictures: /** @type {Api.ExportRequest["pictures"]} */ (pictures.value),
      skip_unreadable: skip.checked,
      split: divide.checked ? split : null,
    };
  }

  function show() {
    const { project } = app.state;
    if (!project) return;
    const sum = (/** @type {string[]} */ ...of) =>
      of.reduce((total, state) => total + (project.labels_by_state[state] ?? 0), 0);
    for (const [i, [state]] of STATES.entries()) counts[i].textContent = count(sum(state), "box");
    // formats with 2D boxes can be exported without 3D labels
    const isFlat = Boolean(formats.find(({ name }) => name === format.value)?.flat);
    picturesField.hidden = !isFlat;
    division.hidden = !divide.checked;
    const chosen = sum(...ticked(states));
    empty.hidden = sum("accepted", "edited", "proposed") > 0;
    form.hidden = sum(...STATES.map(([state]) => state)) + material.image + material.view === 0;
    const hasNone = chosen === 0 && !isFlat;
    note.textContent = hasNone
      ? "No boxes are in the chosen states."
      : `${count(chosen, "box")}. You can leave this page while the dataset is being made.`;
    start.disabled = hasNone || isActive(latestJob(app, "export"));
    const done = jobsOf(app, app.state.route.project, "export").find(({ state }) => state === "done");
    result.hidden = !done;
    if (done) patch(result, describe(done));
  }

  app.state.on("jobs", show, until);
  app.state.on("project", show, until);
  show();
  void app.refreshProject();
}

/** The location of the dataset, its parts, and what its format cannot store. */
function describe(/** @type {Api.Job} */ { id, created_ns, operator, download, result: anything }) {
  const { format, bytes, splits = {}, lost, unreadable, notes = [] } = /** @type {ExportResult} */ (anything ?? {});
  const get = h(
    "a.button.primary-link",
    { href: `/api/jobs/${id}/download`, download: "", "data-testid": "download" },
    "Download the dataset",
  );
  const gone = h("span", { "data-testid": "download-gone" }, "The dataset is no longer kept. Export it again.");
  const made = `made ${dateOf(created_ns / 1e6)} by ${operator}`;
  const about = h("span.muted.number", `${format ? `${format}, ` : ""}${size(bytes)}${made}`);
  const parts = Object.entries(splits).map(([name, frames]) => `${name}: ${count(frames, "frame")}`);
  return [
    h("div.row", download === "gone" ? gone : get, about),
    parts.length > 0 && h("p.number", { "data-testid": "export-parts" }, parts.join(", ")),
    listed("export-lost", "What the format cannot hold", lost),
    listed("export-unreadable", "Frames left out because they cannot be read", unreadable),
    ...notes.map((text) => h("p.help", text)),
  ];
}

const listed = (/** @type {string} */ testid, /** @type {string} */ title, /** @type {string[]} */ texts = []) =>
  texts.length > 0 &&
  h("div", { "data-testid": testid }, h("p.field-label", title), bullets(texts, { class: "help" }));
