/** Export: which boxes leave, in which format; the finished archive is downloaded from here, with what it could not hold. */

import { count, h } from "../dom.js";
import { createJobLine, isActive, latestJob, startJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { createExportForm } from "./form.js";

/** 3400000 -> "3.4 MB, " */
const size = (bytes) => (bytes ? `${(bytes / 1e6).toLocaleString("en", { maximumFractionDigits: 1 })} MB, ` : "");

export function mount(root, app) {
  const body = h("div", { class: "body stack" });
  const stop = [];
  let is_over = false;
  root.append(h("div", { class: "page" }, h("h1", {}, "Export"), h("section", { class: "panel" }, h("header", {}, h("h2", {}, "Make a dataset")), body)));
  begin(app, body, stop, () => is_over).catch((error) => body.replaceChildren(h("p", { class: "error-box", role: "alert" }, error.message)));
  return {
    unmount() {
      is_over = true;
      stop.forEach((end) => end());
    },
  };
}

async function begin(app, body, stop, isOver) {
  const { formats } = await app.api.get("/api/export-formats");
  if (isOver()) return;
  const asked = createExportForm(app, formats, show);
  const start = h("button", { type: "submit", class: "primary", "data-testid": "export-start" }, "Export");
  const note = h("span", { class: "help", "data-testid": "export-note" });
  const problem = h("p", { class: "error-box", role: "alert", hidden: true });
  const line = createJobLine(app, "export");
  const result = h("div", { class: "stack", "data-testid": "export-result" });
  const empty = h("div", { class: "empty" }, h("p", {}, "No box is accepted yet. Review proposals, or label objects, and come back."), h("a", { class: "button", href: makeHash(app.state.route.project, "review") }, "Review"));
  const form = h("form", { class: "stack", "data-testid": "export-form" }, asked.parts, problem, h("div", { class: "row" }, start, note));
  body.replaceChildren(empty, form, line.root, result);

  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    problem.hidden = true;
    start.disabled = true;
    try {
      await startJob(app, asked.request());
    } catch (error) {
      problem.textContent = error.message;
      problem.hidden = false;
    } finally {
      show();
    }
  });

  function show() {
    if (!app.state.project) return;
    asked.show();
    const job = latestJob(app, "export");
    const chosen = asked.chosen();
    empty.hidden = asked.total() > 0;
    const has_none = chosen === 0 && !asked.isFlat();
    note.textContent = has_none ? "No box is in the chosen states." : `${count(chosen, "box", "boxes")}. The archive appears when it is complete; you can leave this page meanwhile.`;
    start.disabled = has_none || Boolean(job && isActive(job));
    line.show();
    const done = app.state.jobs.filter(({ kind, project, state }) => kind === "export" && project === app.state.route.project && state === "done");
    const newest = done.toSorted((a, b) => b.created_ns - a.created_ns)[0];
    result.hidden = !newest;
    if (newest) result.replaceChildren(...told(newest));
  }

  stop.push(app.state.on("jobs", show), app.state.on("project", show));
  show();
  app.refreshProject().catch(app.toast);
}

/** Where the dataset is, its parts, and what its format could not hold. */
function told({ id, created_ns, operator, download, result }) {
  const made = new Date(created_ns / 1e6).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  const get = h("a", { class: "button primary-link", href: `/api/jobs/${id}/download`, download: "", "data-testid": "download" }, "Download the dataset");
  const gone = h("span", { "data-testid": "download-gone" }, "The dataset is no longer kept; export again.");
  const about = h("span", { class: "muted number" }, `${result?.format ? `${result.format}, ` : ""}${size(result?.bytes)}made ${made} by ${operator}`);
  const parts = Object.entries(result?.splits ?? {}).map(([name, frames]) => `${name}: ${count(frames, "frame")}`);
  const lost = result?.lost ?? [];
  const unreadable = result?.unreadable ?? [];
  return [
    h("div", { class: "row" }, download === "gone" ? gone : get, about),
    parts.length ? h("p", { class: "number", "data-testid": "export-parts" }, parts.join(", ")) : null,
    lost.length ? h("div", { "data-testid": "export-lost" }, h("p", { class: "field-label" }, "What the format does not hold"), h("ul", { class: "help" }, lost.map((text) => h("li", {}, text)))) : null,
    unreadable.length ? h("div", { "data-testid": "export-unreadable" }, h("p", { class: "field-label" }, "Frames that cannot be read, left out"), h("ul", { class: "help" }, unreadable.map((text) => h("li", {}, text)))) : null,
    ...(result?.notes ?? []).map((text) => h("p", { class: "help" }, text)),
  ].filter(Boolean);
}
