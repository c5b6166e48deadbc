/** The dialogs that add recordings to a project, and that point to a moved recording. */

import { openDialog } from "../dialogs.js";
import { count, glyph, h } from "../dom.js";
import { projectPath } from "../api.js";
import { ApiError, messageOf } from "../errors.js";
import { createJobLine, takeJob } from "../jobs.js";
import { createFolders } from "./folders.js";
import { chooseTopics } from "./topics.js";

/** What is added of a recording with several cameras, or with a LiDAR that sees more than its camera. */
const CAMERAS = [
  { name: "as the files say", options: {} },
  { name: "all cameras and scenes", options: { scene: "all", camera: "all" } },
  ...[4, 6, 8].map((number) => ({
    name: `${number} virtual cameras all around the LiDAR`,
    options: { look_around: number, camera: "all" },
  })),
];

/**
 * Shows the folders until it is closed, so that several recordings can be added.
 *
 * @param {App} app
 * @param {string} project
 */
export function addRecordings(app, project) {
  const done = h("div", { class: "added", role: "status" });
  const labels = h("input", { type: "checkbox", checked: true, "data-testid": "own-labels" });
  const cameras = h(
    "select",
    { "data-testid": "which-cameras" },
    CAMERAS.map(({ name }, index) => h("option", { value: String(index) }, name)),
  );
  const folders = createFolders(app, {
    text: "Add",
    testid: "add",
    onPick: (entry, button) => add(app, { project, done, labels, cameras }, entry, button),
  });
  // other cameras of a recording that was just added
  cameras.addEventListener("change", () => {
    /** @type {Iterable<HTMLButtonElement>} */
    const added = cameras.closest("dialog")?.querySelectorAll("button[data-testid^='add-']:disabled") ?? [];
    for (const button of added) {
      button.disabled = false;
      button.textContent = "Add";
    }
  });
  const closed = openDialog({
    title: `Add recordings to ${project}`,
    testid: "add-recording-dialog",
    wide: true,
    content: [
      ...folders.nodes,
      h("label", { class: "row" }, labels, "Import the 3D boxes of the recording, if it has any"),
      h("label", { class: "row" }, "Cameras", cameras),
      done,
    ],
    actions: [{ label: "Done", value: "done" }],
  });
  void folders.show("");
  return closed;
}

/**
 * @param {App} app
 * @param {{ project: string, done: HTMLElement, labels: HTMLInputElement, cameras: HTMLSelectElement }} options
 * @param {Api.FolderEntry} entry
 * @param {HTMLButtonElement} button
 * @param {{ options?: object, labels?: boolean, as_new?: boolean, leave_out_broken?: boolean }} [again] what differs
 *   when it is added again.
 */
async function add(app, { project, done, labels, cameras }, entry, button, again = {}) {
  const isBag = entry.recording === "ros_bag";
  const chosen = () => (isBag ? chooseTopics(app, entry) : CAMERAS[Number(cameras.value)].options);
  const options = again.options ?? (await chosen());
  if (options === null) return;
  button.disabled = true;
  button.textContent = "Adding …";
  try {
    /** @type {Api.AddedRecordings} */
    const { added, job, note } = await app.api.post(projectPath(project, "recordings"), {
      path: entry.path,
      labels: labels.checked,
      ...again,
      options,
    });
    done.append(
      ...added.flatMap((one) => [
        h("p", { "data-testid": "added-recording" }, glyph(one.broken.length ? "warning" : "check"), describe(one)),
        ...one.broken.map((text) => h("p", { class: "help", "data-testid": "broken-frames" }, text)),
      ]),
    );
    if (added.some((one) => one.can_leave_out)) {
      const leaveOut = h("button", { type: "button", "data-testid": "leave-out-broken" }, "Leave these frames out");
      leaveOut.addEventListener("click", () => {
        leaveOut.remove();
        const changed = { options, labels: false, leave_out_broken: true };
        void add(app, { project, done, labels, cameras }, entry, button, changed);
      });
      done.append(leaveOut);
    }
    const notes = new Set(added.flatMap((one) => one.notes));
    done.append(...[...notes].map((text) => h("p", { class: "help", "data-testid": "reader-note" }, text)));
    if (job) done.append(jobLine(app, job));
    if (note) done.append(h("p", { class: "error-box", role: "alert", "data-testid": "recording-note" }, note));
    // adding it again starts the job that could not be started, or adds other topics
    const isOpen = Boolean(note) || isBag;
    button.textContent = isOpen ? "Add" : "Added";
    button.disabled = !isOpen;
  } catch (error) {
    button.textContent = "Add";
    button.disabled = false;
    if (error instanceof ApiError && error.body.moved) {
      const choice = await askMoved(app, project, entry, error.body.moved);
      const asNew = { ...again, options, as_new: true };
      if (choice === "new") await add(app, { project, done, labels, cameras }, entry, button, asNew);
      if (choice !== "moved") return;
      const text = `${error.body.moved.name} is now at ${entry.path}, with its labels`;
      done.append(h("p", { "data-testid": "added-recording" }, glyph("check"), text));
      button.textContent = "Added";
      button.disabled = true;
    } else {
      done.append(h("p", { class: "error-box", role: "alert" }, messageOf(error)));
    }
  }
}

/**
 * Offers to set the new path of a recording of the project that is found elsewhere.
 *
 * @param {App} app
 * @param {string} project
 * @param {Api.FolderEntry} entry
 * @param {Api.MissingRecording} moved
 */
function askMoved(app, project, entry, moved) {
  return openDialog({
    title: `${moved.name} has moved`,
    testid: "moved-dialog",
    content: [
      h("p", {}, `${entry.name} has the frames of the recording ${moved.name}, whose folder was not found.`),
      h("p", { class: "help" }, "With the new path, its labels stay. Another recording begins without them."),
    ],
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: "Add as another recording", value: "new" },
      { label: "Use the new path", value: "moved" },
    ],
    async submit(value) {
      if (value === "moved") await app.api.patch(projectPath(project, "recordings", moved.id), { path: entry.path });
      return value;
    },
  });
}

/**
 * The progress of reading the boxes, which continues when the dialog is closed.
 *
 * @param {App} app
 * @param {Api.Job} job
 */
function jobLine(app, job) {
  takeJob(app, job);
  const line = createJobLine(app, "import", () => app.state.jobs.find(({ id }) => id === job.id) ?? job);
  const stop = app.state.on("jobs", () => {
    if (line.root.isConnected) line.show();
    else stop();
  });
  line.show();
  return line.root;
}

/** @param {Api.AddedRecording} options */
function describe({ recording, is_new, new_frames, left_out }) {
  const more = left_out ? `, ${left_out} left out` : "";
  return is_new
    ? `${recording.name}: ${count(recording.frames, "frame")}${more}`
    : `${recording.name} was already in the project: ${count(new_frames, "new frame")}${more}`;
}

/**
 * Asks for the new path of a recording. Returns the recording, or null if the dialog was cancelled.
 *
 * @param {App} app
 * @param {string} project
 * @param {Api.MissingRecording} options
 */
export function locateRecording(app, project, { id, name }) {
  /** @type {string | null} */
  let chosen = null;
  const status = h(
    "p",
    { role: "status", "data-testid": "located" },
    "Choose the folder that now contains its frames.",
  );
  const folders = createFolders(app, {
    text: "Choose",
    testid: "choose",
    onPick: (entry) => {
      chosen = entry.path;
      status.textContent = `Chosen: ${entry.path}`;
    },
  });
  const closed = openDialog({
    title: `Find ${name}`,
    testid: "locate-dialog",
    wide: true,
    content: [
      h(
        "p",
        { class: "help" },
        "Its folder was moved. Boxes and labels are kept, and are shown again when you choose the new folder.",
      ),
      ...folders.nodes,
      status,
    ],
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: "Use this folder", value: "locate" },
    ],
    async submit(value) {
      if (value === "cancel") return null;
      if (chosen === null) throw new Error("Please choose a folder first.");
      return app.api.patch(projectPath(project, "recordings", id), { path: chosen });
    },
  });
  void folders.show("");
  return closed;
}
