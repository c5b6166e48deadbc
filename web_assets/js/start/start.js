/** The start page: the projects with what can be done to them, a new project, and recordings for them. */

import { editClasses } from "../classes/classes.js";
import { button, count, glyph, h, iconButton } from "../dom.js";
import { messageOf } from "../errors.js";
import { createJobLine, followImports, isActive, isOfImport, takeJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { importBoxes } from "./boxes_file.js";
import { createMenu, createProject, createRemoved } from "./manage.js";
import { addRecordings, locateRecording } from "./recordings.js";

const STATES = ["proposed", "accepted", "edited", "rejected"];

export function mount(/** @type {HTMLElement} */ root, /** @type {App} */ app) {
  const list = h("div", { class: "projects", "aria-live": "polite" });
  /** @type {JobLine[]} */
  let lines = [];
  /** The projects whose cards are shown, as text. */
  let shown = "";
  /**
   * Ids of the jobs that import boxes or copy a project and were started here: their outcome stays on the page.
   *
   * @type {Set<string>}
   */
  const started = new Set();
  const removed = createRemoved(app, refresh);
  const page = h(
    "div",
    { class: "page start" },
    h("div", { class: "row" }, h("h1", { class: "grow" }, "Projects"), newButton()),
    list,
    removed.root,
    h("p", { class: "help" }, app.state.version ? `annotator ${app.state.version}` : ""),
  );

  function newButton() {
    return button([glyph("plus"), "New project"], make, { class: "primary", "data-testid": "new-project" });
  }

  async function make() {
    const project = await createProject(app);
    if (!project) return;
    await refresh();
    await add(project.name);
  }

  async function add(/** @type {string} */ name) {
    await addRecordings(app, name);
    await refresh();
  }

  async function locate(/** @type {string} */ name, /** @type {Api.MissingRecording} */ recording) {
    if (await locateRecording(app, name, recording)) await refresh();
  }

  async function change(/** @type {string} */ name) {
    try {
      await editClasses(app, name);
    } catch (error) {
      app.toast(error);
    }
    await refresh();
  }

  async function addBoxes(/** @type {string} */ name) {
    try {
      const job = await importBoxes(app, name);
      if (!job) return;
      started.add(job.id);
      await refresh();
    } catch (error) {
      app.toast(error);
    }
  }

  function begun(/** @type {Api.Job} */ job) {
    started.add(job.id);
    takeJob(app, job);
  }

  async function refresh() {
    try {
      /** @type {Api.ProjectSummary[]} */
      const projects = await app.api.get("/api/projects");
      await removed.load();
      const menu = list.querySelector(":popover-open");
      const text = JSON.stringify(projects);
      // new cards would take an open menu away, and a click whose button is down
      if (text === shown) return showLines();
      if (menu) return menu.addEventListener("toggle", refresh, { once: true });
      shown = text;
      lines = projects.map(({ name }) => importLine(app, name, started));
      list.replaceChildren(
        ...(projects.length
          ? projects.map((project, i) =>
              card(project, {
                add,
                addBoxes,
                locate,
                change,
                line: lines[i].root,
                menu: createMenu(app, project, refresh, begun),
              }),
            )
          : [nothing()]),
      );
      showLines();
    } catch (error) {
      shown = "";
      const retry = button("Try again", refresh);
      list.replaceChildren(h("p", { class: "error-box", role: "alert" }, messageOf(error)), h("div", {}, retry));
    }
  }

  function nothing() {
    return h(
      "div",
      { class: "panel empty", "data-testid": "no-projects" },
      h("h2", {}, "No project yet"),
      h("p", {}, "A project has recordings, their labels, and the detectors that are trained on them."),
      newButton(),
    );
  }

  function showLines() {
    for (const line of lines) line.show();
  }

  const stop = [app.state.on("jobs", showLines), followImports(app, refresh)];
  root.append(page);
  refresh();
  return {
    unmount() {
      for (const end of stop) end();
    },
  };
}

/** The progress of reading boxes of recordings or of a file, or of a copy, or the reason why that failed. */
function importLine(/** @type {App} */ app, /** @type {string} */ project, /** @type {Set<string>} */ started) {
  const own = () =>
    app.state.jobs
      .filter((job) => isOfImport(job) && job.project === project)
      .toSorted((a, b) => b.created_ns - a.created_ns);
  return createJobLine(
    app,
    "import",
    () => own().find(isActive) ?? own().find((job, i) => i === 0 && (job.state === "failed" || started.has(job.id))),
  );
}

/**
 * @param {Api.ProjectSummary} project
 * @param {object} parts
 * @param {(name: string) => void} parts.add
 * @param {(name: string) => void} parts.addBoxes
 * @param {(name: string, recording: Api.MissingRecording) => void} parts.locate
 * @param {(name: string) => void} parts.change
 * @param {HTMLElement} parts.line
 * @param {HTMLElement[]} parts.menu
 */
function card(project, { add, addBoxes, locate, change, line, menu }) {
  const { name, problem } = project;
  const labels = project.labels_by_state;
  const proposed = labels.proposed ?? 0;
  const title = problem
    ? h("h2", { class: "ellipsis" }, name)
    : h("h2", { class: "ellipsis" }, h("a", { href: makeHash(name, "label"), "data-testid": `open-${name}` }, name));
  const box = h("section", { class: "panel project", "data-testid": `project-${name}`, "aria-label": name }, [
    h("div", { class: "row" }, h("span", { class: "grow ellipsis" }, title), menu),
  ]);
  if (problem) {
    box.append(h("p", { class: "error-box" }, problem));
    return box;
  }
  const addButton = button([glyph("plus"), "Recording"], () => add(name), {
    class: project.recordings ? "" : "primary",
    "data-testid": `add-recording-${name}`,
  });
  const boxesButton = button([glyph("plus"), "Boxes"], () => addBoxes(name), {
    "data-testid": `import-boxes-${name}`,
  });
  boxesButton.title = "Import 2D boxes on camera images, or 3D boxes as proposals or labels, from a file";
  boxesButton.hidden = !project.recordings;
  const links = project.recordings
    ? [
        link(name, "label", "Label"),
        link(name, "review", proposed ? `Review ${proposed.toLocaleString("en")}` : "Review", proposed > 0),
      ]
    : [];
  box.append(
    h(
      "p",
      { class: "classes" },
      project.classes.map((label) => h("span", { class: "chip" }, label)),
      iconButton("edit", `Change the classes and attributes of ${name}`, () => change(name), {
        "data-testid": `edit-classes-${name}`,
      }),
    ),
    h(
      "p",
      { class: "number muted" },
      project.recordings
        ? `${count(project.recordings, "recording")}, ${count(project.frames, "frame")}`
        : "No recording yet: add one to begin.",
    ),
    h("p", { class: "number states" }, stateCounts(labels)),
    ...project.missing.map((recording) => missing(recording, () => locate(name, recording))),
    line,
    h("div", { class: "row" }, links, addButton, boxesButton),
  );
  return box;
}

function missing(/** @type {Api.MissingRecording} */ { name }, /** @type {() => void} */ onLocate) {
  const locate = button("Locate …", onLocate, { "data-testid": `locate-${name}` });
  return h(
    "div",
    { class: "row missing" },
    h("span", { class: "grow bad" }, `${name}: its folder was not found`),
    locate,
  );
}

function link(
  /** @type {string} */ name,
  /** @type {string} */ mode,
  /** @type {string} */ text,
  /** @type {boolean} */ isPrimary = false,
) {
  return h("a", { class: `button${isPrimary ? " strong" : ""}`, href: makeHash(name, mode) }, text);
}

function stateCounts(/** @type {Record<string, number>} */ labels) {
  const known = STATES.filter((state) => labels[state] > 0);
  if (!known.length) return [h("span", { class: "muted" }, "no labels")];
  return known.map((state) =>
    h("span", { class: `state-${state}` }, `${labels[state].toLocaleString("en")} ${state}`),
  );
}
