/** The menu of a project's card: its recordings, and renaming, copying and removing it. */

import { projectPath } from "../api.js";
import { openDialog } from "../dialogs.js";
import { count, glyph, h } from "../dom.js";
import { manageRecordings } from "./recordings_list.js";

/**
 * A button that opens the menu.
 *
 * @param {App} app
 * @param {Api.ProjectSummary} project
 * @param {() => unknown} refresh called when something has changed.
 * @param {(job: Api.Job) => unknown} onJob called with a job that was started.
 */
export function createMenu(app, project, refresh, onJob) {
  const { name } = project;
  /**
   * @param {string} id
   * @param {string} label
   * @param {() => Promise<unknown>} act
   */
  const item = (id, label, act) =>
    h(
      "button",
      { type: "button", class: "quiet", role: "menuitem", "data-testid": `${id}-${name}`, onclick: () => run(act) },
      label,
    );
  const remove = item("remove", "Remove …", () => removeProject(app, project));
  const items = project.problem
    ? [remove]
    : [
        item("recordings", "Recordings …", () => manageRecordings(app, name)),
        item("rename", "Rename …", () => rename(app, name)),
        item("copy", "Copy …", async () => {
          const job = await copy(app, project);
          if (job) onJob(job);
        }),
        remove,
      ];
  const list = h("div", { class: "menu", popover: "auto", role: "menu", "aria-label": `Project ${name}` }, items);
  const button = h("button", {
    type: "button",
    class: "icon quiet",
    title: "Recordings, rename, copy, remove",
    "aria-label": `More about ${name}`,
    "aria-haspopup": "menu",
    "data-testid": `menu-${name}`,
  });
  button.append(glyph("more"));
  button.popoverTargetElement = list;
  list.addEventListener("beforetoggle", () => {
    const { right, bottom } = button.getBoundingClientRect();
    list.style.top = `${bottom}px`;
    list.style.right = `${document.documentElement.clientWidth - right}px`;
  });

  /** @param {() => Promise<unknown>} act */
  async function run(act) {
    list.hidePopover();
    try {
      await act();
    } catch (error) {
      app.toast(error);
    }
    await refresh();
  }

  return [button, list];
}

/**
 * @param {string} label
 * @param {string} value
 */
function nameField(label, value) {
  const input = h("input", {
    required: true,
    maxlength: 64,
    autofocus: true,
    autocomplete: "off",
    value,
    "data-testid": "new-name",
  });
  return { input, root: h("label", { class: "field" }, h("span", {}, label), input) };
}

/**
 * @param {App} app
 * @param {string} project
 */
function rename(app, project) {
  const { input, root } = nameField("New name", project);
  return openDialog({
    title: `Rename ${project}`,
    testid: "rename-dialog",
    content: [root, h("p", { class: "help" }, "Its folder is renamed, too. Pages that show the project follow.")],
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: "Rename", value: "rename" },
    ],
    submit: (value) =>
      value === "cancel" ? null : app.api.post(projectPath(project, "rename"), { name: input.value.trim() }),
  });
}

/**
 * Starts a job that copies the project. Returns the job, or null if the dialog was cancelled.
 *
 * @param {App} app
 * @param {Api.ProjectSummary} project
 * @returns {Promise<Api.Job | null>}
 */
function copy(app, project) {
  const { input, root } = nameField("Name of the copy", `${project.name}-copy`);
  const labels = h("input", { type: "checkbox", checked: true, "data-testid": "copy-labels" });
  return openDialog({
    title: `Copy ${project.name}`,
    testid: "copy-dialog",
    content: [
      root,
      h("label", { class: "row" }, labels, `With its ${count(numberOfLabels(project), "label")}`),
      h(
        "p",
        { class: "help" },
        "The copy has the same classes, settings and detectors, and reads the same recordings.",
      ),
    ],
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: "Copy", value: "copy" },
    ],
    submit(value) {
      if (value === "cancel") return null;
      const request = { kind: "copy", name: input.value.trim(), labels: labels.checked };
      return app.api.post(projectPath(project.name, "jobs"), request);
    },
  });
}

/**
 * @param {App} app
 * @param {Api.ProjectSummary} project
 */
async function removeProject(app, project) {
  const { name, problem } = project;
  const labels = numberOfLabels(project);
  const { input, root } = nameField(`To remove it, type its name: ${name}`, "");
  const mustType = labels > 0 || Boolean(problem);
  /** @type {Api.RemovedProject | null} */
  const removed = await openDialog({
    title: `Remove ${name}`,
    testid: "remove-dialog",
    content: [
      h(
        "p",
        {},
        problem
          ? "It cannot be opened, so what it holds is not known."
          : `It has ${count(project.recordings, "recording")} and ${count(labels, "label")}.`,
      ),
      h(
        "p",
        { class: "help" },
        "Nothing is deleted: its folder is moved to .removed beside the projects, with labels and detectors. " +
          "The files of its recordings stay where they are.",
      ),
      ...(mustType ? [root] : []),
    ],
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: "Remove", value: "remove", kind: "danger" },
    ],
    submit(value) {
      if (value === "cancel") return null;
      if (mustType && input.value.trim() !== name) throw new Error(`Please type the name of the project: ${name}`);
      return app.api.del(projectPath(name));
    },
  });
  if (removed === null) return;
  await openDialog({
    title: `${name} was removed`,
    testid: "removed-dialog",
    content: [
      h("p", {}, "To bring it back, run this command beside the folder of projects:"),
      h("code", {}, removed.command),
      h("p", { class: "help" }, `To free its space, delete the folder ${removed.folder}.`),
    ],
    actions: [{ label: "Close", value: "close" }],
  });
}

/** @param {Api.ProjectSummary} project */
const numberOfLabels = ({ labels_by_state: states }) => Object.values(states).reduce((sum, number) => sum + number, 0);
