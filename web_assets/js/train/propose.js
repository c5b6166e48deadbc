/** Proposes boxes on the chosen recordings, or from 2D boxes on the images, then links to their review. */

import { count, h } from "../dom.js";
import { checkbox, numberField, numberOf, remembered, ticked } from "../forms.js";
import { createJobForm, createJobLine, isActive, latestJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { measuredBy } from "../start/boxes_file.js";

export function createPropose(/** @type {HTMLElement} */ host, /** @type {ModeApp} */ app) {
  const choices = h("div.choices-list", { role: "group", "aria-label": "Recordings" });
  const limits = { min: 1, step: 1, placeholder: "all" };
  const limit = remembered(app, "propose", "limit", numberField("propose-limit", "Maximum number of frames", limits));
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
  const liftText = h("span.grow", { "data-testid": "lift" });
  const { form: liftForm, start: liftStart } = createJobForm(app, {
    name: "lift",
    label: "Propose 3D boxes from these",
    content: (start) => [h("div.row", liftText, start)],
    request: () => ({ kind: "lift" }),
    show,
  });
  host.append(
    h("header", h("h2", "Propose boxes"), h("span.grow"), review),
    h("div.body.stack", liftForm, createJobLine(app, "lift"), form, createJobLine(app, "propose")),
  );
  let toLift = 0;

  function show() {
    const { project } = app.state;
    if (!project) return;
    for (const { id, name, frames } of project.recordings) {
      if (boxes.has(id)) continue;
      const box = checkbox(null, true, { value: id });
      boxes.set(id, box);
      choices.append(h("label.row", box, h("span.ellipsis", name), h("span.muted.number", count(frames, "frame"))));
    }
    const view = measuredBy(project);
    liftForm.hidden = toLift === 0 || isActive(latestJob(app, "lift"));
    liftStart.disabled = !view;
    const have = toLift === 1 ? "has" : "have";
    const how = view ? `Measured by: ${view}.` : "This needs a view detector: train one first.";
    liftText.textContent = `${count(toLift, "frame")} ${have} 2D boxes on the image, but no 3D boxes. ${how}`;
    const { image, stand_in } = project.detectors;
    const ready = image !== null && view !== null;
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
