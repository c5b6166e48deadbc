/** The dialogs that add recordings to a project, and that find one again whose folder was moved. */

import { openDialog } from "../dialogs.js";
import { count, glyph, h } from "../dom.js";
import { projectPath } from "../api.js";
import { createJobLine, takeJob } from "../jobs.js";
import { createFolders } from "./folders.js";

/** Shows the folders until it is closed; several recordings can be added one after the other. */
export function addRecordings(app, project) {
  const done = h("div", { class: "added", role: "status" });
  const labels = h("input", { type: "checkbox", checked: true, "data-testid": "own-labels" });
  const folders = createFolders(app, { text: "Add", testid: "add", onPick: (entry, button) => add(app, { project, done, labels }, entry, button) });
  const closed = openDialog({
    title: `Add recordings to ${project}`,
    testid: "add-recording-dialog",
    wide: true,
    content: [...folders.nodes, h("label", { class: "row" }, labels, "Take over the 3D boxes that a recording brings, where it has any"), done],
    actions: [{ label: "Done", value: "done" }],
  });
  void folders.show("");
  return closed;
}

async function add(app, { project, done, labels }, entry, button) {
  button.disabled = true;
  button.textContent = "Adding …";
  try {
    const { added, job, note } = await app.api.post(projectPath(project, "recordings"), { path: entry.path, labels: labels.checked });
    done.append(...added.map((one) => h("p", { "data-testid": "added-recording" }, glyph("check"), describe(one))));
    if (job) done.append(jobLine(app, job));
    if (note) done.append(h("p", { class: "error-box", role: "alert", "data-testid": "recording-note" }, note));
    // added again, what could not be begun is
    button.textContent = note ? "Add" : "Added";
    button.disabled = !note;
  } catch (error) {
    done.append(h("p", { class: "error-box", role: "alert" }, error.message));
    button.textContent = "Add";
    button.disabled = false;
  }
}

/** How far the boxes are read; it goes on when the dialog is closed. */
function jobLine(app, job) {
  takeJob(app, job);
  const line = createJobLine(app, "import", () => app.state.jobs.find(({ id }) => id === job.id) ?? job);
  const stop = app.state.on("jobs", () => (line.root.isConnected ? line.show() : stop()));
  line.show();
  return line.root;
}

function describe({ recording, is_new, new_frames }) {
  return is_new ? `${recording.name}: ${count(recording.frames, "frame")}` : `${recording.name} was there already: ${count(new_frames, "new frame")}`;
}

/** Asks where a recording is now; what the server knows of it since, or null where it was given up. */
export function locateRecording(app, project, { id, name }) {
  let chosen = null;
  const told = h("p", { role: "status", "data-testid": "located" }, "Choose the folder with the same frames.");
  const folders = createFolders(app, {
    text: "Choose",
    testid: "choose",
    onPick: (entry) => {
      chosen = entry.path;
      told.textContent = `Chosen: ${entry.path}`;
    },
  });
  const closed = openDialog({
    title: `Where is ${name} now?`,
    testid: "locate-dialog",
    wide: true,
    content: [h("p", { class: "help" }, "Its folder is not where it was. Boxes and labels are kept; they wait for their pictures."), ...folders.nodes, told],
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
