/** Export: which boxes leave, in which format; the finished archive is downloaded from here. */

import { count, h } from "../dom.js";
import { createJobLine, isActive, latestJob, startJob } from "../jobs.js";
import { makeHash } from "../router.js";

const STATES = [
  ["accepted", "accepted", true],
  ["edited", "edited", true],
  ["proposed", "proposed, not reviewed", false],
];
const FORMATS = [["rcv", "3D_HUMAN / 3D_HAND style: images, clouds, 2D boxes and oriented 3D boxes"]];

/** 3400000 -> "3.4 MB, " */
const size = (bytes) => (bytes ? `${(bytes / 1e6).toLocaleString("en", { maximumFractionDigits: 1 })} MB, ` : "");

export function mount(root, app) {
  const states = STATES.map(([state, , on]) => h("input", { type: "checkbox", checked: on, onchange: show, "data-testid": `export-state-${state}` }));
  const counts = STATES.map(() => h("span", { class: "muted number" }));
  const classes = app.state.project.classes.map((name) => h("input", { type: "checkbox", checked: true, value: name }));
  const format = h("select", { "data-testid": "export-format" }, FORMATS.map(([value, text]) => h("option", { value }, text)));
  const start = h("button", { type: "submit", class: "primary", "data-testid": "export-start" }, "Export");
  const note = h("span", { class: "help", "data-testid": "export-note" });
  const problem = h("p", { class: "error-box", role: "alert", hidden: true });
  const line = createJobLine(app, "export");
  const result = h("div", { class: "row", "data-testid": "export-result" });
  const empty = h("div", { class: "empty" }, h("p", {}, "No box is accepted yet. Review proposals, or label objects, and come back."), h("a", { class: "button", href: makeHash(app.state.route.project, "review") }, "Review"));
  const form = h(
    "form",
    { class: "stack", "data-testid": "export-form" },
    h("fieldset", { class: "plain" }, h("legend", { class: "field-label" }, "Boxes"), STATES.map(([, text], i) => h("label", { class: "row" }, states[i], text, counts[i]))),
    classes.length > 1 ? h("fieldset", { class: "plain" }, h("legend", { class: "field-label" }, "Classes"), h("div", { class: "row" }, classes.map((box) => h("label", { class: "row" }, box, box.value)))) : null,
    h("label", { class: "field" }, h("span", {}, "Format"), format),
    problem,
    h("div", { class: "row" }, start, note),
  );
  root.append(h("div", { class: "page" }, h("h1", {}, "Export"), h("section", { class: "panel" }, h("header", {}, h("h2", {}, "Make a dataset")), h("div", { class: "body stack" }, empty, form, line.root, result))));

  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    problem.hidden = true;
    start.disabled = true;
    try {
      const chosen = STATES.map(([state]) => state).filter((_, i) => states[i].checked);
      const kept = classes.filter((box) => box.checked).map((box) => box.value);
      if (chosen.length === 0 || kept.length === 0) throw new Error("Choose at least one state and one class.");
      await startJob(app, { kind: "export", format: format.value, states: chosen, classes: kept.length === classes.length ? null : kept });
    } catch (error) {
      problem.textContent = error.message;
      problem.hidden = false;
    } finally {
      show();
    }
  });

  function show() {
    const job = latestJob(app, "export");
    const by_state = app.state.project?.labels_by_state ?? {};
    counts.forEach((span, i) => (span.textContent = count(by_state[STATES[i][0]] ?? 0, "box", "boxes")));
    const total = STATES.reduce((sum, [state]) => sum + (by_state[state] ?? 0), 0);
    empty.hidden = total > 0;
    const chosen = STATES.reduce((sum, [state], i) => sum + (states[i].checked ? (by_state[state] ?? 0) : 0), 0);
    note.textContent = chosen === 0 ? "No box is in the chosen states." : `${count(chosen, "box", "boxes")}. The archive appears when it is complete; you can leave this page meanwhile.`;
    start.disabled = chosen === 0 || Boolean(job && isActive(job));
    line.show();
    const done = app.state.jobs.filter(({ kind, project, state }) => kind === "export" && project === app.state.route.project && state === "done");
    result.hidden = done.length === 0;
    const newest = done.toSorted((a, b) => b.created_ns - a.created_ns)[0];
    if (newest) {
      const made = new Date(newest.created_ns / 1e6).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
      const told = h("span", { class: "muted number" }, `${size(newest.result?.bytes)}made ${made} by ${newest.operator}`);
      result.replaceChildren(newest.download === "gone" ? gone() : link(newest), told);
    }
  }

  function link({ id }) {
    return h("a", { class: "button primary-link", href: `/api/jobs/${id}/download`, download: "", "data-testid": "download" }, "Download the dataset");
  }

  function gone() {
    return h("span", { "data-testid": "download-gone" }, "The dataset is no longer kept; export again.");
  }

  const stop = [app.state.on("jobs", show), app.state.on("project", show)];
  show();
  app.refreshProject().catch(app.toast);
  return { unmount: () => stop.forEach((end) => end()) };
}
