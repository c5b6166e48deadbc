/** Proposes boxes on the chosen recordings, or from 2D boxes on the images, then links to their review. */

import { button, count, h } from "../dom.js";
import { checkbox, numberField, numberOf, remembered, ticked } from "../forms.js";
import { createJobForm, createJobLine, isActive, latestJob, startJob, takeJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { importBoxes, measuredBy } from "../start/boxes_file.js";

export function createPropose(/** @type {HTMLElement} */ host, /** @type {ModeApp} */ app) {
  const line = createJobLine(app, "propose");
  const liftLine = createJobLine(app, "lift");
  const boxesLine = createJobLine(app, "boxes");
  const importButton = button("Import boxes …", addBoxes, { "data-testid": "import-boxes" });
  const choices = h("div.choices-list", { role: "group", "aria-label": "Recordings" });
  const limit = remembered(
    app,
    "propose",
    "limit",
    numberField("propose-limit", "Maximum number of frames", { min: 1, step: 1, placeholder: "all" }),
  );
  const note = h("p.help");
  const review = h("a.button.primary-link", { "data-testid": "review-proposals" });
  /** By the id of the recording. @type {Map<number, HTMLInputElement>} */
  const boxes = new Map();
  const { form, start } = createJobForm(app, {
    name: "propose",
    label: "Propose",
    content: (start) => [
      choices,
      h("div.row", h("label.row", "At most", limit, "frames"), note, h("span.grow"), start),
    ],
    request() {
      const chosen = ticked([...boxes.values()]).map(Number);
      if (chosen.length === 0) throw new Error("Choose at least one recording.");
      const recordings = chosen.length === boxes.size ? null : chosen;
      return { kind: "propose", recordings, limit: numberOf(limit) };
    },
    show,
  });
  const liftText = h("span.grow");
  const liftStart = button("Propose 3D boxes from these", startLift, {
    class: "primary",
    "data-testid": "lift-start",
  });
  const lift = h("div.row", { hidden: true, "data-testid": "lift" }, liftText, liftStart);
  host.append(
    h("header", h("h2", "Propose boxes"), h("span.grow"), importButton, review),
    h("div.body.stack", boxesLine, lift, liftLine, form, line),
  );
  let toLift = 0;

  async function startLift() {
    liftStart.disabled = true;
    try {
      await startJob(app, { kind: "lift" });
    } finally {
      show();
    }
  }

  async function addBoxes() {
    const job = await importBoxes(app, app.state.route.project);
    if (job) takeJob(app, job);
  }

  function showLift(/** @type {Api.ProjectInfo} */ project) {
    const view = measuredBy(project);
    lift.hidden = toLift === 0 || isActive(latestJob(app, "lift"));
    liftStart.disabled = !view;
    const have = toLift === 1 ? "has" : "have";
    const how = view ? `Measured by: ${view}.` : "This needs a view detector: train one first.";
    liftText.textContent = `${count(toLift, "frame")} ${have} 2D boxes on the image, but no 3D boxes. ${how}`;
  }

  function show() {
    const { project } = app.state;
    if (!project) return;
    for (const { id, name, frames } of project.recordings) {
      if (boxes.has(id)) continue;
      const box = checkbox(null, true, { value: id });
      boxes.set(id, box);
      choices.append(h("label.row", box, h("span.ellipsis", name), h("span.muted.number", count(frames, "frame"))));
    }
    showLift(project);
    const { image, stand_in } = project.detectors;
    const ready = image !== null && measuredBy(project) !== null;
    start.disabled = !ready || project.recordings.length === 0 || isActive(latestJob(app, "propose"));
    const kept = "Reviewed boxes and finalised frames are not changed.";
    const missing = `Train ${stand_in ? "an image detector" : "both detectors"} first, or choose one that was trained.`;
    note.textContent = [ready ? kept : missing, stand_in ? `View detector: ${stand_in}.` : ""].join(" ").trim();
    const waiting = project.labels_by_state.proposed ?? 0;
    review.hidden = waiting === 0;
    review.textContent = `Review ${count(waiting, "proposal")}`;
    review.href = makeHash(project.name, "annotate");
  }

  return {
    show,
    /** Sets the number of frames with 2D boxes on the image, but no 3D box. */
    setToLift(/** @type {number} */ frames) {
      toLift = frames;
      show();
    },
  };
}
