/** Proposes boxes on the chosen recordings, then links to their review. */

import { count, h } from "../dom.js";
import { messageOf } from "../errors.js";
import { createJobLine, isActive, latestJob, startJob } from "../jobs.js";
import { makeHash } from "../router.js";

/**
 * @param {HTMLElement} host
 * @param {ModeApp} app
 */
export function createPropose(host, app) {
  const line = createJobLine(app, "propose");
  const choices = h("div", { class: "choices-list", role: "group", "aria-label": "Recordings" });
  const limit = h("input", {
    type: "number",
    min: 1,
    step: 1,
    placeholder: "all",
    "aria-label": "Maximum number of frames",
    "data-testid": "propose-limit",
  });
  const start = h("button", { type: "submit", class: "primary", "data-testid": "propose-start" }, "Propose");
  const note = h("p", { class: "help" });
  const problem = h("p", { class: "error-box", role: "alert", hidden: true });
  const review = h("a", { class: "button primary-link", "data-testid": "review-proposals" });
  const form = h(
    "form",
    { class: "stack", "data-testid": "propose-form" },
    choices,
    h(
      "div",
      { class: "row" },
      h("label", { class: "row" }, "At most", limit, "frames"),
      note,
      h("span", { class: "grow" }),
      start,
    ),
    problem,
  );
  host.append(
    h("header", {}, h("h2", {}, "Propose boxes"), h("span", { class: "grow" }), review),
    h("div", { class: "body stack" }, form, line.root),
  );
  const boxes = new Map();

  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    problem.hidden = true;
    start.disabled = true;
    try {
      const chosen = [...boxes].filter(([, box]) => box.checked).map(([id]) => id);
      if (chosen.length === 0) throw new Error("Choose at least one recording.");
      const recordings = chosen.length === boxes.size ? null : chosen;
      await startJob(app, { kind: "propose", recordings, limit: limit.value === "" ? null : limit.valueAsNumber });
    } catch (error) {
      problem.textContent = messageOf(error);
      problem.hidden = false;
    } finally {
      show();
    }
  });

  function show() {
    const { project } = app.state;
    if (!project) return;
    for (const { id, name, frames } of project.recordings) {
      if (boxes.has(id)) continue;
      const box = h("input", { type: "checkbox", checked: true });
      boxes.set(id, box);
      choices.append(
        h(
          "label",
          { class: "row" },
          box,
          h("span", { class: "ellipsis" }, name),
          h("span", { class: "muted number" }, count(frames, "frame")),
        ),
      );
    }
    line.show();
    const job = latestJob(app, "propose");
    const ready = project.detectors.image !== null && project.detectors.view !== null;
    start.disabled = !ready || project.recordings.length === 0 || Boolean(job && isActive(job));
    note.textContent = ready ? "Reviewed boxes and finalised frames are not changed." : "Train both detectors first.";
    const waiting = project.labels_by_state.proposed ?? 0;
    review.hidden = waiting === 0;
    review.textContent = `Review ${count(waiting, "proposal")}`;
    review.href = makeHash(project.name, "review");
  }

  return { show };
}
