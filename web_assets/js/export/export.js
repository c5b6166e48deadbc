/** Export: which boxes, in which format; then the download, with a list of what the format cannot store. */

import { bullets, count, dateOf, h, nothing, patch } from "../dom.js";
import { errorBox } from "../forms.js";
import { createJobForm, createJobLine, isActive, jobsOf, latestJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { createExportForm } from "./form.js";

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
  /** @type {Api.FormatInfo[]} */
  const formats = await app.api.get("/api/export-formats");
  if (until.aborted) return;
  const asked = createExportForm(app, formats, show);
  const note = h("span.help", { "data-testid": "export-note" });
  const line = createJobLine(app, "export");
  const result = h("div.stack", { "data-testid": "export-result" });
  const text = "No boxes are accepted yet. Review proposals, or label objects, first.";
  const empty = nothing("", text, makeHash(app.state.route.project, "annotate"), "Annotate");
  const { form, start } = createJobForm(app, {
    name: "export",
    label: "Export",
    content: (start) => [...asked.parts, h("div.row", start, note)],
    request: asked.request,
    show,
  });
  form.classList.add("choices-of-export");
  body.replaceChildren(empty, form, line, result);

  function show() {
    if (!app.state.project) return;
    asked.show();
    const chosen = asked.chosen();
    empty.hidden = asked.total() > 0;
    const hasNone = chosen === 0 && !asked.isFlat();
    note.textContent = hasNone
      ? "No boxes are in the chosen states."
      : `${count(chosen, "box", "boxes")}. You can leave this page while the dataset is being made.`;
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
