/** Export: which boxes, in which format; then the download, with a list of what the format cannot store. */

import { count, h, patch } from "../dom.js";
import { messageOf } from "../errors.js";
import { createJobLine, isActive, latestJob, startJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { createExportForm } from "./form.js";

/** 3400000 -> "3.4 MB, " */
const size = (/** @type {number | undefined} */ bytes) =>
  bytes ? `${(bytes / 1e6).toLocaleString("en", { maximumFractionDigits: 1 })} MB, ` : "";

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  const body = h("div", { class: "body stack" });
  /** @type {(() => void)[]} */
  const stop = [];
  let isOver = false;
  root.append(
    h(
      "div",
      { class: "page" },
      h("h1", {}, "Export"),
      h("section", { class: "panel" }, h("header", {}, h("h2", {}, "Make a dataset")), body),
    ),
  );
  begin(app, body, stop, () => isOver).catch((error) =>
    body.replaceChildren(h("p", { class: "error-box", role: "alert" }, messageOf(error))),
  );
  return {
    unmount() {
      isOver = true;
      for (const end of stop) end();
    },
  };
}

async function begin(
  /** @type {ModeApp} */ app,
  /** @type {HTMLElement} */ body,
  /** @type {(() => void)[]} */ stop,
  /** @type {() => boolean} */ isOver,
) {
  /** @type {Api.FormatInfo[]} */
  const formats = await app.api.get("/api/export-formats");
  if (isOver()) return;
  const asked = createExportForm(app, formats, show);
  const start = h("button", { type: "submit", class: "primary", "data-testid": "export-start" }, "Export");
  const note = h("span", { class: "help", "data-testid": "export-note" });
  const problem = h("p", { class: "error-box", role: "alert", hidden: true });
  const line = createJobLine(app, "export");
  const result = h("div", { class: "stack", "data-testid": "export-result" });
  const empty = h(
    "div",
    { class: "empty" },
    h("p", {}, "No boxes are accepted yet. Review proposals, or label objects, first."),
    h("a", { class: "button", href: makeHash(app.state.route.project, "annotate") }, "Annotate"),
  );
  const form = h(
    "form",
    { class: "stack choices-of-export", "data-testid": "export-form" },
    asked.parts,
    problem,
    h("div", { class: "row" }, start, note),
  );
  body.replaceChildren(empty, form, line.root, result);

  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    problem.hidden = true;
    start.disabled = true;
    try {
      await startJob(app, asked.request());
    } catch (error) {
      problem.textContent = messageOf(error);
      problem.hidden = false;
    } finally {
      show();
    }
  });

  function showResult(/** @type {Api.Job | undefined} */ job) {
    result.hidden = !job;
    if (job) patch(result, describe(job));
  }

  function show() {
    if (!app.state.project) return;
    asked.show();
    const job = latestJob(app, "export");
    const chosen = asked.chosen();
    empty.hidden = asked.total() > 0;
    const hasNone = chosen === 0 && !asked.isFlat();
    note.textContent = hasNone
      ? "No boxes are in the chosen states."
      : `${count(chosen, "box", "boxes")}. You can leave this page while the dataset is being made.`;
    start.disabled = hasNone || Boolean(job && isActive(job));
    line.show();
    const done = app.state.jobs.filter(
      ({ kind, project, state }) => kind === "export" && project === app.state.route.project && state === "done",
    );
    showResult(done.toSorted((a, b) => b.created_ns - a.created_ns)[0]);
  }

  stop.push(app.state.on("jobs", show), app.state.on("project", show));
  show();
  app.refreshProject().catch(app.toast);
}

/** The location of the dataset, its parts, and what its format cannot store. */
function describe(/** @type {Api.Job} */ { id, created_ns, operator, download, result: anything }) {
  /** @type {ExportResult | null} */
  const result = anything;
  const made = new Date(created_ns / 1e6).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  const get = h(
    "a",
    { class: "button primary-link", href: `/api/jobs/${id}/download`, download: "", "data-testid": "download" },
    "Download the dataset",
  );
  const gone = h("span", { "data-testid": "download-gone" }, "The dataset is no longer kept. Export it again.");
  const about = h(
    "span",
    { class: "muted number" },
    `${result?.format ? `${result.format}, ` : ""}${size(result?.bytes)}made ${made} by ${operator}`,
  );
  const parts = Object.entries(result?.splits ?? {}).map(([name, frames]) => `${name}: ${count(frames, "frame")}`);
  const lost = result?.lost ?? [];
  const unreadable = result?.unreadable ?? [];
  return [
    h("div", { class: "row" }, download === "gone" ? gone : get, about),
    parts.length ? h("p", { class: "number", "data-testid": "export-parts" }, parts.join(", ")) : null,
    lost.length
      ? h(
          "div",
          { "data-testid": "export-lost" },
          h("p", { class: "field-label" }, "What the format cannot hold"),
          h(
            "ul",
            { class: "help" },
            lost.map((text) => h("li", {}, text)),
          ),
        )
      : null,
    unreadable.length
      ? h(
          "div",
          { "data-testid": "export-unreadable" },
          h("p", { class: "field-label" }, "Frames left out because they cannot be read"),
          h(
            "ul",
            { class: "help" },
            unreadable.map((text) => h("li", {}, text)),
          ),
        )
      : null,
    ...(result?.notes ?? []).map((text) => h("p", { class: "help" }, text)),
  ].filter((part) => part !== null);
}
