/** The dialogs that add recordings to a project, and that point to a moved recording. */

import { projectPath } from "../api.js";
import { confirm, openDialog } from "../dialogs.js";
import { button, count, glyph, h, patch } from "../dom.js";
import { ApiError, messageOf } from "../errors.js";
import { createJobLine, takeJob } from "../jobs.js";
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

/** Shows the folders until it is closed, so that several recordings can be added. */
export function addRecordings(/** @type {App} */ app, /** @type {string} */ project) {
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
  const leaveOut = (/** @type {string} */ text, /** @type {object} */ more) => {
    const leave = h("button", { type: "button", "data-testid": "leave-out-broken" }, text);
    leave.addEventListener("click", () => {
      leave.remove();
      void add(app, { project, done, labels, cameras }, entry, button, {
        ...again,
        options,
        leave_out_broken: true,
        ...more,
      });
    });
    return leave;
  };
  try {
    /** @type {Api.AddedRecordings} */
    const { added, job, note } = await app.api.post(projectPath(project, "recordings"), {
      path: entry.path,
      labels: labels.checked,
      ...again,
      options,
    });
    done.append(
      ...added.flatMap((one) => {
        const isBroken = one.broken.length > 0;
        const [icon, look] = isBroken
          ? /** @type {const} */ (["warning", "warn"])
          : /** @type {const} */ (["check", ""]);
        return [
          h("p", { class: look, "data-testid": "added-recording" }, glyph(icon), describe(one)),
          ...one.broken.map((text) => h("p", { class: "help", "data-testid": "broken-frames" }, text)),
        ];
      }),
    );
    if (added.some((one) => one.can_leave_out)) done.append(leaveOut("Leave these frames out", { labels: false }));
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
      if (error instanceof ApiError && error.kind === "BrokenStartError")
        done.append(leaveOut("Try all frames, and leave out those that cannot be read", {}));
    }
    done.lastElementChild?.scrollIntoView({ block: "nearest" });
  }
}

/** Offers to set the new path of a recording of the project that is found elsewhere. */
function askMoved(
  /** @type {App} */ app,
  /** @type {string} */ project,
  /** @type {Api.FolderEntry} */ entry,
  /** @type {Api.MissingRecording} */ moved,
) {
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

/** The progress of reading the boxes, which continues when the dialog is closed. */
function jobLine(/** @type {App} */ app, /** @type {Api.Job} */ job) {
  takeJob(app, job);
  const line = createJobLine(app, "import", () => app.state.jobs.find(({ id }) => id === job.id) ?? job);
  const stop = app.state.on("jobs", () => {
    if (line.root.isConnected) line.show();
    else stop();
  });
  line.show();
  return line.root;
}

function describe(/** @type {Api.AddedRecording} */ { recording, is_new, new_frames, left_out }) {
  const more = left_out ? `, ${left_out} left out` : "";
  return is_new
    ? `${recording.name}: ${count(recording.frames, "frame")}${more}`
    : `${recording.name} was already in the project: ${count(new_frames, "new frame")}${more}`;
}

/** Asks for the new path of a recording. Returns the recording, or null if the dialog was cancelled. */
export function locateRecording(
  /** @type {App} */ app,
  /** @type {string} */ project,
  /** @type {Api.MissingRecording} */ { id, name },
) {
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

// -- the dialog with all recordings of a project

/** Shows the recordings until the dialog is closed. */
export async function manageRecordings(/** @type {App} */ app, /** @type {string} */ project) {
  const list = h("ul", { class: "recordings", role: "status" });
  const path = (/** @type {(string | number)[]} */ ...parts) => projectPath(project, "recordings", ...parts);

  async function show(/** @type {Promise<Api.ListedRecording[]>} */ answer) {
    try {
      const recordings = await answer;
      patch(list, recordings.length ? recordings.map(row) : h("li", { class: "muted" }, "No recording yet"));
    } catch (error) {
      app.toast(error);
    }
  }

  function row(/** @type {Api.ListedRecording} */ recording) {
    const { id, name, frames, labels, missing, removed_by } = recording;
    const isGone = removed_by !== null;
    const numbers = [...(isGone ? [] : [count(frames, "frame")]), count(labels, "label")].join(", ");
    const states = [...(isGone ? [`removed by ${removed_by}`] : []), ...(missing ? ["its folder was not found"] : [])];
    return h(
      "li",
      { class: "row", "data-testid": `recording-${name}`, "data-key": id },
      h("span", { class: `grow ellipsis${isGone ? " muted" : ""}`, title: name }, name),
      h("span", { class: "muted number" }, numbers),
      h("span", { class: missing ? "bad" : "muted" }, states.join("; ")),
      missing && button("Locate …", () => locate(recording), { "data-testid": "locate" }),
      isGone &&
        !missing &&
        button("Bring back", () => show(app.api.post(path(id, "restore"))), { "data-testid": "restore" }),
      !isGone && button("Remove …", () => remove(recording), { "data-testid": "remove" }),
    );
  }

  async function locate(/** @type {Api.ListedRecording} */ recording) {
    if (await locateRecording(app, project, recording)) await show(app.api.get(path()));
  }

  async function remove(/** @type {Api.ListedRecording} */ { id, name, labels }) {
    const until = "are not shown, counted, exported or trained on until you bring it back.";
    const text = `${labels ? `Its ${count(labels, "label")} ${until} ` : ""}Its files stay where they are.`;
    if (await confirm(`Remove ${name} from ${project}?`, text, "Remove", "danger")) {
      await show(app.api.del(path(id)));
    }
  }

  await show(app.api.get(path()));
  return openDialog({
    title: `Recordings of ${project}`,
    testid: "recordings-dialog",
    wide: true,
    content: [list],
    actions: [{ label: "Done", value: "done" }],
  });
}

// -- a browser of the server's folders

/**
 * @param {App} app
 * @param {Picker} options
 * @returns {{nodes: Node[], show: (path: string) => Promise<void>}} the elements, and the function that
 *     opens a folder; "" lists the server's folders.
 */
export function createFolders(app, options) {
  const crumbs = h("nav", { class: "crumbs grow", "aria-label": "Folder" });
  const typed = h("input", {
    placeholder: "or type a path, then Enter",
    "aria-label": "Path of a folder or recording on the server",
    "data-testid": "folder-path",
    onkeydown(/** @type {KeyboardEvent} */ event) {
      if (event.key !== "Enter") return;
      // not the dialog's own action
      event.preventDefault();
      event.stopPropagation();
      void show(
        typed.value
          .trim()
          .replace(/^["']|["']$/g, "")
          .replace(/(.)\/$/, "$1"),
      );
    },
  });
  const list = h("ul", { class: "folders", "data-testid": "folders", tabindex: -1 });

  let asked = 0;

  async function show(/** @type {string} */ wanted) {
    asked += 1;
    const own = asked;
    const before = typed.value;
    try {
      /** @type {Api.FolderListing} */
      const { path, here, entries, notes, kinds } = await app.api.get(
        `/api/folders?path=${encodeURIComponent(wanted)}`,
      );
      if (own !== asked) return;
      // what is typed meanwhile stays
      if (typed.value === before) typed.value = path;
      crumbs.replaceChildren(...makeCrumbs(path, show));
      list.replaceChildren(
        ...[...(here ? [{ ...here, is_folder: false }] : []), ...entries].map((entry) =>
          makeEntry(entry, show, options),
        ),
        ...explain(path, entries.length > 0 || here !== null, notes, kinds),
      );
      if (document.activeElement !== typed) list.focus();
    } catch (error) {
      if (own !== asked) return;
      list.replaceChildren(h("li", { class: "error-box", role: "alert" }, messageOf(error)));
    }
  }

  return { nodes: [h("div", { class: "row" }, crumbs, typed), list], show };
}

/** What is not listed, and what to look for where there is no recording. */
function explain(
  /** @type {string} */ path,
  /** @type {boolean} */ hasAny,
  /** @type {string[]} */ notes,
  /** @type {string[]} */ kinds,
) {
  /** @type {HTMLElement[]} */
  const lines = notes.map((text) => h("p", {}, `${text[0].toUpperCase()}${text.slice(1)}.`));
  if (!hasAny && !notes.length)
    lines.push(
      h("p", {}, path ? "This folder is empty." : "This server offers no folder. Whoever runs it can offer some."),
    );
  if (kinds.length)
    lines.push(
      h(
        "details",
        { open: !hasAny },
        h("summary", {}, "What a recording must have"),
        h(
          "ul",
          {},
          kinds.map((text) => h("li", {}, text)),
        ),
      ),
    );
  return lines.length ? [h("li", { class: "help", "data-testid": "folder-notes" }, lines)] : [];
}

function makeCrumbs(/** @type {string} */ path, /** @type {(path: string) => void} */ show) {
  const parts = path ? path.split("/") : [];
  const step = (/** @type {string} */ text, /** @type {string} */ target) =>
    button(text, () => show(target), { class: "quiet" });
  return [
    step("Folders", ""),
    ...parts.flatMap((part, i) => [h("span", { class: "muted" }, "/"), step(part, parts.slice(0, i + 1).join("/"))]),
  ];
}

function makeEntry(
  /** @type {Api.FolderEntry} */ entry,
  /** @type {(path: string) => void} */ show,
  /** @type {Picker} */ { text, testid, onPick },
) {
  const name = h("span", { class: "grow ellipsis", title: entry.name }, entry.name);
  const openButton = button([glyph("folder"), name], () => show(entry.path), {
    class: "quiet entry",
    "data-testid": `folder-${entry.name}`,
  });
  if (entry.recording === null) return h("li", {}, openButton);
  /** @type {HTMLButtonElement} */
  const pick = button(text, () => onPick(entry, pick), { class: "primary", "data-testid": `${testid}-${entry.name}` });
  return h(
    "li",
    { class: "entry recording" },
    entry.is_folder ? openButton : name,
    h("span", { class: "chip format" }, entry.recording.replaceAll("_", " ")),
    pick,
  );
}
