/** The start page: the projects with what can be done to them, a new project, and recordings for them. */

import { projectPath } from "../api.js";
import { editClasses } from "../classes/classes.js";
import { button, count, glyph, h, iconButton } from "../dom.js";
import { messageOf } from "../errors.js";
import { guide } from "../guide.js";
import { createJobLine, followImports, isActive, isOfImport, takeJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { importBoxes } from "./boxes_file.js";
import { createMenu, createProject, createRemoved } from "./manage.js";
import { addRecordings, locateRecording } from "./recordings.js";

const STATES = ["proposed", "accepted", "edited", "rejected"];
/** Classes that a card names; of more, it says how many there are. */
const NAMED = 8;
/** From a drag to a dataset. @type {["drag" | "box" | "track" | "download", string, string][]} */
const STEPS = [
  ["drag", "Drag a 2D box", "around an object on the camera image."],
  ["box", "Take the 3D box", "that is measured in the points, or correct it."],
  ["track", "Follow it", "through the recording, and review what was found."],
  ["download", "Export", "in the format of your training: KITTI, nuScenes, OpenLABEL …"],
];

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
  /** Id of the job that makes a sample for this operator. */
  let sample = "";
  const removed = createRemoved(app, refresh);
  /** To begin a project; where there is none yet, the list has it. */
  const begin = h("div", { class: "row" });
  const page = h(
    "div",
    { class: "page start" },
    h("div", { class: "row" }, h("h1", { class: "grow" }, "Projects"), begin),
    list,
    removed.root,
    h("p", { class: "help" }, app.state.version ? `annotator ${app.state.version}` : ""),
  );

  function newButton(look = "primary") {
    return button([glyph("plus"), "New project"], make, { class: look, "data-testid": "new-project" });
  }

  function sampleButton(look = "") {
    return button("Try a sample project", () => begunSample(), {
      class: look,
      title: "Makes a project with a generated recording, in some seconds, and shows what to do with it",
      "data-testid": "sample-project",
    });
  }

  async function begunSample() {
    try {
      /** @type {Api.Sample} */
      const { name, job } = await app.api.post("/api/sample-project");
      if (!job) return open(name);
      sample = job.id;
      takeJob(app, job);
      await refresh();
    } catch (error) {
      app.toast(error);
    }
  }

  function open(/** @type {string} */ name) {
    guide(name);
    app.go(makeHash(name, "annotate"));
  }

  /** Opens the sample once it is there. */
  function openSample() {
    const job = app.state.jobs.find(({ id, state }) => id === sample && state === "done");
    if (job) open(job.project);
    return Boolean(job);
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
    // signed out: the page is loaded again after the next sign-in
    if (!app.state.operator) return;
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
      begin.replaceChildren(...(projects.length ? [sampleButton(), newButton()] : []));
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
      h(
        "ol",
        { class: "first-steps" },
        STEPS.map(([icon, title, text]) => h("li", {}, glyph(icon), h("strong", {}, title), text)),
      ),
      h("div", { class: "row" }, sampleButton("primary"), newButton("")),
      h("p", {}, "The sample is a generated recording, made in some seconds. A guide leads through these steps."),
    );
  }

  function showLines() {
    for (const line of lines) line.show();
  }

  const stop = [app.state.on("jobs", showLines), followImports(app, () => openSample() || refresh())];
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
  const title = problem
    ? h("h2", { class: "ellipsis" }, name)
    : h(
        "h2",
        { class: "ellipsis" },
        h("a", { href: makeHash(name, "annotate"), "data-testid": `open-${name}` }, name),
      );
  const box = h("section", { class: "panel project", "data-testid": `project-${name}`, "aria-label": name }, [
    h("div", { class: "row" }, h("span", { class: "grow ellipsis" }, title), menu),
  ]);
  if (problem) {
    box.append(h("p", { class: "error-box" }, problem));
    return box;
  }
  const isEmpty = project.recordings === 0;
  const addButton = button([glyph("plus"), "Recording"], () => add(name), {
    class: isEmpty ? "primary" : "",
    "data-testid": `add-recording-${name}`,
  });
  const boxesButton = button([glyph("plus"), "Boxes"], () => addBoxes(name), {
    "data-testid": `import-boxes-${name}`,
  });
  boxesButton.title = "Import 2D boxes on camera images, or 3D boxes as proposals or labels, from a file";
  boxesButton.hidden = isEmpty;
  const next = nextStep(project);
  const others = project.classes.slice(NAMED);
  const done = `${project.frames_done.toLocaleString("en")} of ${count(project.frames, "frame")} done`;
  box.prepend(picture(project));
  box.append(
    h(
      "p",
      { class: "classes" },
      project.classes.slice(0, NAMED).map((label) => h("span", { class: "chip" }, label)),
      others.length ? h("span", { class: "chip", title: others.join(", ") }, `+ ${others.length}`) : null,
      iconButton("edit", `Change the classes and attributes of ${name}`, () => change(name), {
        "data-testid": `edit-classes-${name}`,
      }),
    ),
    h(
      "p",
      { class: "number muted" },
      isEmpty ? "No recording yet: add one to begin." : `${count(project.recordings, "recording")}, ${done}`,
    ),
    isEmpty
      ? ""
      : h("progress", { max: project.frames || 1, value: project.frames_done, "aria-label": done, title: done }),
    isEmpty ? "" : h("p", { class: "number states" }, stateCounts(labels)),
    ...project.missing.map((recording) => missing(recording, () => locate(name, recording))),
    line,
    h("div", { class: "row next" }, next ? link(name, next.mode, next.text) : addButton),
    h("div", { class: "row" }, isEmpty ? null : addButton, boxesButton),
  );
  return box;
}

/** What to do next in a project with recordings. */
export function nextStep(
  /** @type {Api.ProjectSummary} */ { frames, frames_done, labels_by_state: labels, recordings },
) {
  const proposed = labels.proposed ?? 0;
  const reviewed = (labels.accepted ?? 0) + (labels.edited ?? 0);
  if (!recordings) return null;
  if (proposed) return { mode: "annotate", text: `Review ${count(proposed, "proposal")}` };
  if (!reviewed) return { mode: "annotate", text: "Draw the first box" };
  if (frames_done < frames) return { mode: "annotate", text: "Go on with the next frame" };
  return { mode: "export", text: "Export the boxes" };
}

/** The first frame of a project, over a sign that is seen where there is none. */
function picture(/** @type {Api.ProjectSummary} */ { name, first_frame }) {
  const attributes = { class: "picture", href: makeHash(name, "annotate"), tabindex: -1, "aria-hidden": "true" };
  const frame = h("a", attributes, glyph("box"));
  if (first_frame === null) return frame;
  const src = `${projectPath(name, "frames", first_frame)}/image.jpg?width=320`;
  // a frame that cannot be read has none
  frame.append(
    h("img", {
      src,
      alt: "",
      loading: "lazy",
      onerror: (/** @type {Event} */ { target }) => target instanceof Element && target.remove(),
    }),
  );
  return frame;
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

function link(/** @type {string} */ name, /** @type {string} */ mode, /** @type {string} */ text) {
  return h("a", { class: "button primary-link", href: makeHash(name, mode), "data-testid": `next-${name}` }, text);
}

function stateCounts(/** @type {Record<string, number>} */ labels) {
  const known = STATES.filter((state) => labels[state] > 0);
  if (!known.length) return [h("span", { class: "muted" }, "no boxes yet")];
  return known.map((state) =>
    h("span", { class: `state-${state}` }, `${labels[state].toLocaleString("en")} ${state}`),
  );
}
