/** The dialogs that add recordings to a project, and that point to a moved recording. */

import { openDialog } from "../dialogs.js";
import { count, glyph, h } from "../dom.js";
import { projectPath } from "../api.js";
import { messageOf } from "../errors.js";
import { createJobLine, takeJob } from "../jobs.js";
import { createFolders } from "./folders.js";

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
 */
async function add(app, { project, done, labels, cameras }, entry, button) {
  button.disabled = true;
  button.textContent = "Adding …";
  try {
    /** @type {Api.AddedRecordings} */
    const { added, job, note } = await app.api.post(projectPath(project, "recordings"), {
      path: entry.path,
      labels: labels.checked,
      options: CAMERAS[Number(cameras.value)].options,
    });
    done.append(...added.map((one) => h("p", { "data-testid": "added-recording" }, glyph("check"), describe(one))));
    const notes = new Set(added.flatMap((one) => one.notes));
    done.append(...[...notes].map((text) => h("p", { class: "help", "data-testid": "reader-note" }, text)));
    if (job) done.append(jobLine(app, job));
    if (note) done.append(h("p", { class: "error-box", role: "alert", "data-testid": "recording-note" }, note));
    // adding it again starts the job that could not be started
    button.textContent = note ? "Add" : "Added";
    button.disabled = !note;
  } catch (error) {
    done.append(h("p", { class: "error-box", role: "alert" }, messageOf(error)));
    button.textContent = "Add";
    button.disabled = false;
  }
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
function describe({ recording, is_new, new_frames }) {
  return is_new
    ? `${recording.name}: ${count(recording.frames, "frame")}`
    : `${recording.name} was already in the project: ${count(new_frames, "new frame")}`;
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
