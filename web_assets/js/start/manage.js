/** The menu of a project's card: its recordings, and renaming, copying and removing it. */

import { projectPath } from "../api.js";
import { CANCEL, confirm, openDialog } from "../dialogs.js";
import { button, count, dateOf, glyph, h } from "../dom.js";
import { checkbox, field, partsOf } from "../forms.js";

import { manageRecordings } from "./recordings.js";

/**
 * A button that opens the menu.
 *
 * @param {App} app
 * @param {Api.ProjectSummary} project
 * @param {import("./start.js").Act} act
 */
export function createMenu(app, project, act) {
  const { name } = project;
  const item = (
    /** @type {string} */ id,
    /** @type {string} */ label,
    /** @type {Parameters<typeof act>[0]} */ change,
  ) => button(label, act(change), { class: "quiet", role: "menuitem", "data-testid": `${id}-${name}` });
  const remove = item("remove", "Remove …", () => removeProject(app, project));
  const others = [
    item("recordings", "Recordings …", () => manageRecordings(app, name)),
    item("rename", "Rename …", () => rename(app, name)),
    item("copy", "Copy …", () => copy(app, project)),
  ];
  const items = [project.problem ? [] : others, remove].flat();
  const list = h("div.menu", { popover: "auto", role: "menu", "aria-label": `Project ${name}` }, items);
  const opener = button(glyph("more"), null, {
    class: "icon quiet",
    title: "Recordings, rename, copy, remove",
    "aria-label": `More about ${name}`,
    "aria-haspopup": "menu",
    "data-testid": `menu-${name}`,
  });
  opener.popoverTargetElement = list;
  list.addEventListener("beforetoggle", () => {
    const { right, bottom } = opener.getBoundingClientRect();
    list.style.top = `${bottom}px`;
    list.style.right = `${document.documentElement.clientWidth - right}px`;
  });
  return [opener, list];
}

/** A field for a name that is needed. */
function nameField(/** @type {Attributes} */ attributes) {
  return h("input", { required: true, maxlength: 64, autofocus: true, autocomplete: "off", ...attributes });
}

async function rename(/** @type {App} */ app, /** @type {string} */ project) {
  const input = nameField({ value: project, "data-testid": "new-name" });
  await openDialog({
    title: `Rename ${project}`,
    testid: "rename-dialog",
    content: [
      field("New name", input),
      h("p.help", "Its folder is renamed, too. Pages that show the project follow."),
    ],
    actions: [CANCEL, { label: "Rename", value: "rename" }],
    submit: () => app.api.post(projectPath(project, "rename"), { name: input.value.trim() }),
  });
}

/**
 * Starts a job that copies the project. Returns the job, or null if the dialog was cancelled.
 *
 * @returns {Promise<Api.Job | null>}
 */
function copy(/** @type {App} */ app, /** @type {Api.ProjectSummary} */ project) {
  const input = nameField({ value: `${project.name}-copy`, "data-testid": "new-name" });
  const labels = checkbox("copy-labels", true);
  return openDialog({
    title: `Copy ${project.name}`,
    testid: "copy-dialog",
    content: [
      field("Name of the copy", input),
      h("label.row", labels, `With its ${count(numberOfLabels(project), "label")}`),
      h("p.help", "The copy has the same classes, settings and detectors, and reads the same recordings."),
    ],
    actions: [CANCEL, { label: "Copy", value: "copy" }],
    submit() {
      const request = { kind: "copy", name: input.value.trim(), labels: labels.checked };
      return app.api.post(projectPath(project.name, "jobs"), request);
    },
  });
}

async function removeProject(/** @type {App} */ app, /** @type {Api.ProjectSummary} */ project) {
  const { name, problem } = project;
  const holds = problem
    ? "It cannot be opened, so what it holds is not known."
    : `It has ${count(project.recordings, "recording")} and ${count(numberOfLabels(project), "label")}.`;
  const text =
    `${holds} Nothing is deleted: you can bring it back, with labels and detectors, at the end of the list of projects. ` +
    "The files of its recordings stay where they are.";
  if (await confirm(`Remove ${name}`, text, "Remove", "danger")) await app.api.del(projectPath(name));
}

const numberOfLabels = (/** @type {Api.ProjectSummary} */ { labels_by_state: states }) =>
  Object.values(states).reduce((sum, number) => sum + number, 0);

/** A removed project, which can be brought back. */
export function removedRow(
  /** @type {App} */ app,
  /** @type {Api.RemovedProject} */ { id, name, removed_s },
  /** @type {import("./start.js").Act} */ act,
) {
  const restore = act(async () => {
    await app.api.post(`/api/removed-projects/${encodeURIComponent(id)}/restore`);
  });
  return h("li.row", [
    h("span.ellipsis", name),
    h("span.muted", `removed ${dateOf(removed_s * 1000)}`),
    button("Bring back", restore, { "data-testid": `bring-back-${name}` }),
  ]);
}

// -- the dialog that creates a project

const ROTATIONS = [
  ["auto", "Automatic", "Upright where the recording has an up direction, free elsewhere."],
  ["upright", "Upright", "Boxes turn only about the vertical: people, cars, furniture."],
  ["free", "Free", "Boxes turn in any direction: hands, tools, parts in a bin."],
];

/** Asks for name, classes and rotation. Returns the project's summary, or null if the dialog was cancelled. */
export function createProject(/** @type {App} */ app) {
  const name = nameField({ name: "name", placeholder: "street-hands", "data-testid": "project-name" });
  const classes = h("input", {
    name: "classes",
    required: true,
    placeholder: "hand, cup",
    autocomplete: "off",
    "data-testid": "project-classes",
  });
  const rotation = (/** @type {string} */ value) =>
    h("input", {
      type: "radio",
      name: "rotation",
      value,
      checked: value === "auto",
      "data-testid": `rotation-${value}`,
    });
  const rotations = ROTATIONS.map(([value, title, help]) =>
    h("label.choice", rotation(value), h("span", h("strong", title), h("span.help", help))),
  );
  return openDialog({
    title: "New project",
    testid: "new-project-dialog",
    content: [
      field("Name", name, "Letters, digits, '-' and '_'. The project's folder gets this name."),
      field("Classes", classes, "Separated by commas. The first nine get the keys 1 to 9. You can add more later."),
      h("fieldset.choices", h("legend.field-label", "Rotation of boxes"), rotations),
    ],
    actions: [CANCEL, { label: "Create", value: "create" }],
    async submit(_, form) {
      const labels = partsOf(classes.value, ",");
      if (!name.value.trim()) throw new Error("Please give the project a name.");
      if (!labels.length) throw new Error("Please name at least one class: the kind of object that you label.");
      const chosen = new FormData(form).get("rotation");
      return app.api.post("/api/projects", { name: name.value.trim(), classes: labels, rotation: chosen });
    },
  });
}
