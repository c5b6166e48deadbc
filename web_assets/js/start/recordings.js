/** The dialogs that add recordings to a project, and that point to a moved recording. */

import { newest, projectPath, withQuery } from "../api.js";
import { CANCEL, confirm, openDialog } from "../dialogs.js";
import { bullets, button, count, glyph, h, patch } from "../dom.js";
import { ApiError, messageOf } from "../errors.js";
import { checkbox, errorBox, onEnter, select } from "../forms.js";
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
export async function addRecordings(/** @type {App} */ app, /** @type {string} */ project) {
  const done = h("div.added", { role: "status" });
  const labels = checkbox("own-labels", true);
  const choices = CAMERAS.map(({ name }, index) => [String(index), name]);
  const cameras = select(choices, { "data-testid": "which-cameras", onchange: offerAll });
  const folders = createFolders(app, { text: "Add", testid: "add", onPick: (entry, button) => add(entry, button) });
  const say = (/** @type {string} */ testid, /** @type {string} */ text) =>
    done.append(h("p.help", { "data-testid": testid }, text));
  const tell = (/** @type {"check" | "warning"} */ icon, /** @type {string} */ text) =>
    done.append(
      h("p", { class: icon === "warning" ? "warn" : null, "data-testid": "added-recording" }, glyph(icon), text),
    );

  /** What can be done about what was said last, one of these. */
  function ask(/** @type {[testid: string, text: string, act: () => unknown][]} */ ...answers) {
    const row = h("div.row");
    const once = (/** @type {() => unknown} */ act) => () => {
      row.remove();
      return act();
    };
    row.append(...answers.map(([testid, text, act]) => button(text, once(act), { "data-testid": testid })));
    done.append(row);
  }

  /** Lets a recording be added, once more or again; with another text it cannot be. */
  function offer(/** @type {Element} */ pick, text = "Add") {
    pick.textContent = text;
    pick.toggleAttribute("disabled", text !== "Add");
  }

  /** Other cameras of a recording that was just added can be added. */
  function offerAll() {
    for (const pick of folders.list.querySelectorAll("button:disabled")) offer(pick);
  }

  /**
   * @param {Api.FolderEntry} entry
   * @param {HTMLButtonElement} pick
   * @param {{ options?: object, labels?: boolean, as_new?: boolean, leave_out_broken?: boolean }} [again] what differs
   *   when it is added again.
   */
  async function add(entry, pick, again = {}) {
    const isBag = entry.recording === "ros_bag";
    const chosen = () => (isBag ? chooseTopics(app, entry) : CAMERAS[Number(cameras.value)].options);
    const options = again.options ?? (await chosen());
    if (options === null) return;
    offer(pick, "Adding …");
    const repeat = (/** @type {typeof again} */ more) => () => add(entry, pick, { ...again, options, ...more });
    try {
      const body = { path: entry.path, labels: labels.checked, ...again, options };
      const { added, job, note } = await app.api.post(projectPath(project, "recordings"), body);
      for (const one of added) {
        tell(one.broken.length > 0 ? "warning" : "check", describe(one));
        for (const text of one.broken) say("broken-frames", text);
      }
      if (added.some((one) => one.can_leave_out))
        ask(["leave-out-broken", "Leave these frames out", repeat({ labels: false, leave_out_broken: true })]);
      for (const text of new Set(added.flatMap(({ notes }) => notes))) say("reader-note", text);
      if (job) {
        takeJob(app, job);
        done.append(createJobLine(app, "import", () => app.state.jobs.find(({ id }) => id === job.id)));
      }
      if (note) done.append(errorBox(note, "recording-note"));
      // adding it again starts the job that could not be started, or adds other topics
      offer(pick, note || isBag ? "Add" : "Added");
    } catch (error) {
      offer(pick);
      const { moved } = error instanceof ApiError ? error.body : {};
      if (moved) {
        const text = `${entry.name} has the frames of the recording ${moved.name}, whose folder was not found. `;
        say("moved", `${text}With the new path, its labels stay. Another recording begins without them.`);
        ask(
          ["add-as-new", "Add as another recording", repeat({ as_new: true })],
          ["use-new-path", "Use the new path", () => move(moved, entry, pick)],
        );
      } else done.append(errorBox(error));
      if (error instanceof ApiError && error.kind === "BrokenStartError") {
        const text = "Try all frames, and leave out those that cannot be read";
        ask(["leave-out-broken", text, repeat({ leave_out_broken: true })]);
      }
    }
    done.lastElementChild?.scrollIntoView({ block: "nearest" });
  }

  /** Sets the new path of a recording of the project that is found elsewhere. */
  async function move(
    /** @type {Api.MissingRecording} */ { id, name },
    /** @type {Api.FolderEntry} */ { path },
    /** @type {Element} */ pick,
  ) {
    await app.api.patch(projectPath(project, "recordings", id), { path });
    tell("check", `${name} is now at ${path}, with its labels`);
    offer(pick, "Added");
  }

  await openDialog({
    title: `Add recordings to ${project}`,
    testid: "add-recording-dialog",
    wide: true,
    content: [
      ...folders.nodes,
      h("label.row", labels, "Import the 3D boxes of the recording, if it has any"),
      h("label.row", "Cameras", cameras),
      done,
    ],
    actions: [{ label: "Done", value: "done" }],
  });
}

function describe(/** @type {Api.AddedRecording} */ { recording, is_new, new_frames, left_out }) {
  const more = left_out ? `, ${left_out} left out` : "";
  return is_new
    ? `${recording.name}: ${count(recording.frames, "frame")}${more}`
    : `${recording.name} was already in the project: ${count(new_frames, "new frame")}${more}`;
}

/** Asks for the new path of a recording. */
export async function locateRecording(
  /** @type {App} */ app,
  /** @type {string} */ project,
  /** @type {Api.MissingRecording} */ { id, name },
) {
  /** @type {string | null} */
  let chosen = null;
  const text = "Choose the folder that now contains its frames.";
  const status = h("p", { role: "status", "data-testid": "located" }, text);
  const folders = createFolders(app, {
    text: "Choose",
    testid: "choose",
    onPick: (entry) => {
      chosen = entry.path;
      status.textContent = `Chosen: ${entry.path}`;
    },
  });
  await openDialog({
    title: `Find ${name}`,
    testid: "locate-dialog",
    wide: true,
    content: [
      h(
        "p.help",
        "Its folder was moved. Boxes and labels are kept, and are shown again when you choose the new folder.",
      ),
      ...folders.nodes,
      status,
    ],
    actions: [CANCEL, { label: "Use this folder", value: "locate" }],
    async submit() {
      if (chosen === null) throw new Error("Please choose a folder first.");
      return app.api.patch(projectPath(project, "recordings", id), { path: chosen });
    },
  });
}

// -- the dialog with all recordings of a project

/** Shows the recordings until the dialog is closed. */
export async function manageRecordings(/** @type {App} */ app, /** @type {string} */ project) {
  const list = h("ul.recordings", { role: "status" });
  const path = (/** @type {(string | number)[]} */ ...parts) => projectPath(project, "recordings", ...parts);

  async function show(/** @type {Promise<Api.ListedRecording[]>} */ answer) {
    const recordings = await answer;
    patch(list, recordings.length ? recordings.map(row) : h("li.muted", "No recording yet"));
  }

  function row(/** @type {Api.ListedRecording} */ recording) {
    const { id, name, frames, labels, missing, removed_by } = recording;
    const isGone = removed_by !== null;
    const numbers = [isGone ? "" : `${count(frames, "frame")}, `, count(labels, "label")];
    const states = [isGone && `removed by ${removed_by}`, missing && "its folder was not found"].filter(Boolean);
    return h("li.row", { "data-testid": `recording-${name}`, "data-key": id }, [
      h("span", { class: `grow ellipsis${isGone ? " muted" : ""}`, title: name }, name),
      h("span.muted.number", numbers),
      h("span", { class: missing ? "bad" : "muted" }, states.join("; ")),
      isGone && button("Bring back", () => show(app.api.post(path(id, "restore"))), { "data-testid": "restore" }),
      !isGone && button("Remove …", () => remove(recording), { "data-testid": "remove" }),
    ]);
  }

  async function remove(/** @type {Api.ListedRecording} */ { id, name, labels }) {
    const until = "are not shown, counted, exported or trained on until you bring it back.";
    const text = `${labels ? `Its ${count(labels, "label")} ${until} ` : ""}Its files stay where they are.`;
    if (await confirm(`Remove ${name} from ${project}?`, text, "Remove", "danger")) await show(app.api.del(path(id)));
  }

  await show(app.api.get(path()));
  await openDialog({
    title: `Recordings of ${project}`,
    testid: "recordings-dialog",
    wide: true,
    content: [list],
    actions: [{ label: "Done", value: "done" }],
  });
}

// -- a browser of the server's folders

/**
 * Shows the server's folders, and then what is in those that are opened.
 *
 * @param {App} app
 * @param {Picker} picker
 * @returns {{nodes: Node[], list: HTMLElement}} the elements, and that with the folders.
 */
function createFolders(app, { text, testid, onPick }) {
  const crumbs = h("nav.crumbs.grow", { "aria-label": "Folder" });
  /** @type {HTMLInputElement} */
  const typed = h("input", {
    placeholder: "or type a path, then Enter",
    "aria-label": "Path of a folder or recording on the server",
    "data-testid": "folder-path",
    // as a terminal copies it: with quotes around it, or a slash at its end
    onkeydown: onEnter(() => show(typed.value.trim().replace(/^["']|(?<=.)\/?["']?$/g, ""))),
  });
  const list = h("ul.folders", { "data-testid": "folders", tabindex: -1 });
  const begin = newest();

  /** Opens a folder; "": the list of the server's folders. */
  async function show(/** @type {string} */ wanted) {
    const isNewest = begin();
    const before = typed.value;
    try {
      const answer = await app.api.get(withQuery("/api/folders", { path: wanted }));
      if (!isNewest()) return;
      const { path, here, entries } = answer;
      // what is typed meanwhile stays
      if (typed.value === before) typed.value = path;
      const parts = path ? path.split("/") : [];
      crumbs.replaceChildren(
        crumb("Folders", ""),
        ...parts.flatMap((part, i) => [h("span.muted", "/"), crumb(part, parts.slice(0, i + 1).join("/"))]),
      );
      const all = here ? [{ ...here, is_folder: false }, ...entries] : entries;
      list.replaceChildren(...all.map(row), ...explained(answer));
      if (document.activeElement !== typed) list.focus();
    } catch (error) {
      if (isNewest()) list.replaceChildren(h("li.error-box", { role: "alert" }, messageOf(error)));
    }
  }

  const crumb = (/** @type {string} */ name, /** @type {string} */ path) =>
    button(name, () => show(path), { class: "quiet" });

  function row(/** @type {Api.FolderEntry} */ entry) {
    const name = h("span.grow.ellipsis", { title: entry.name }, entry.name);
    const look = { class: "quiet entry", "data-testid": `folder-${entry.name}` };
    const open = button([glyph("folder"), name], () => show(entry.path), look);
    if (entry.recording === null) return h("li", open);
    const more = { class: "primary", "data-testid": `${testid}-${entry.name}` };
    /** @type {HTMLButtonElement} */
    const pick = button(text, () => onPick(entry, pick), more);
    const format = h("span.chip.format", entry.recording.replaceAll("_", " "));
    return h("li.entry.recording", entry.is_folder ? open : name, format, pick);
  }

  void show("");
  return { nodes: [h("div.row", crumbs, typed), list], list };
}

/** What is not listed, and what to look for where there is no recording. */
function explained(/** @type {Api.FolderListing} */ { entries, notes, kinds }) {
  if (!notes.length && !kinds.length) return [];
  const texts = notes.map((text) => h("p", `${text[0].toUpperCase()}${text.slice(1)}.`));
  const about = h("details", { open: !entries.length }, h("summary", "What a recording must have"), bullets(kinds));
  return [h("li.help", { "data-testid": "folder-notes" }, texts, kinds.length > 0 && about)];
}
