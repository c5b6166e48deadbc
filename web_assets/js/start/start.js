/** The start page: the projects with what can be done to them, a new project, and recordings for them. */

import { projectPath } from "../api.js";
import { editClasses } from "../classes/classes.js";
import { STATES } from "../colors.js";
import { button, count, glyph, h, iconButton, patch } from "../dom.js";
import { errorBox } from "../forms.js";
import { guide } from "../guide.js";
import { createJobLine, isActive, jobsOf, OF_START, takeJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { importBoxes } from "./boxes_file.js";
import { createMenu, createProject, removedRow } from "./manage.js";
import { addRecordings, locateRecording } from "./recordings.js";

/** @typedef {(change: () => Promise<Api.Job | null | void>) => () => Promise<void>} Act */

/** Classes that a card names; of more, it says how many there are. */
const NAMED = 8;
/** From a drag to a dataset. @type {["drag" | "box" | "track" | "download", string, string][]} */
const STEPS = [
  ["drag", "Drag a 2D box", "around an object on the camera image."],
  ["box", "Take the 3D box", "that is measured in the points, or correct it."],
  ["track", "Follow it", "through the recording, and review what was found."],
  ["download", "Export", "in the format of your training: KITTI, nuScenes, OpenLABEL …"],
];

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  const list = h("div.projects", { "aria-live": "polite" });
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
  const removedList = h("ul.recordings");
  const removed = h("details", { hidden: true, "data-testid": "removed" }, [
    h("summary", "Removed projects"),
    removedList,
  ]);
  /** To begin a project; where there is none yet, the list has it. */
  const begin = h("div.row");
  root.append(
    h("div.page.start", [
      h("div.row", h("h1.grow", "Projects"), begin),
      list,
      removed,
      h("p.help", app.state.version ? `annotator ${app.state.version}` : ""),
    ]),
  );

  function newButton(look = "primary") {
    return button([glyph("plus"), "New project"], make, { class: look, "data-testid": "new-project" });
  }

  function sampleButton(look = "") {
    return button("Try a sample project", makeSample, {
      class: look,
      title: "Makes a project with a generated recording, in some seconds, and shows what to do with it",
      "data-testid": "sample-project",
    });
  }

  async function makeSample() {
    const { name, job } = await app.api.post("/api/sample-project");
    if (!job) return open(name);
    sample = job.id;
    takeJob(app, job);
    // it may be made already
    if (!openSample()) await refresh();
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
    await addRecordings(app, project.name).finally(refresh);
  }

  /** Does something, then shows the projects again, also if that failed; the outcome of its job stays. @type {Act} */
  const act = (change) => async () => {
    for (const menu of list.querySelectorAll("[popover]")) /** @type {HTMLElement} */ (menu).hidePopover();
    try {
      const job = await change();
      if (!job) return;
      started.add(job.id);
      takeJob(app, job);
    } finally {
      await refresh();
    }
  };

  async function refresh() {
    // signed out: the page is loaded again after the next sign-in
    if (!app.state.operator) return;
    try {
      const projects = await app.api.get("/api/projects");
      const gone = await app.api.get("/api/removed-projects");
      removed.hidden = gone.length === 0;
      patch(
        removedList,
        gone.map((one) => removedRow(app, one, act)),
      );
      const menu = list.querySelector(":popover-open");
      const text = JSON.stringify(projects);
      // new cards would take an open menu away, and a click whose button is down
      if (text === shown) return;
      if (menu) return menu.addEventListener("toggle", refresh, { once: true });
      shown = text;
      const cards = projects.map((project) => card(app, project, act, importLine(app, project.name, started)));
      begin.replaceChildren(...(cards.length ? [sampleButton(), newButton()] : []));
      list.replaceChildren(...(cards.length ? cards : [nothing()]));
    } catch (error) {
      shown = "";
      list.replaceChildren(errorBox(error), h("div", button("Try again", refresh)));
    }
  }

  function nothing() {
    return h("div.panel.empty", { "data-testid": "no-projects" }, [
      h("h2", "No project yet"),
      h(
        "ol.first-steps",
        STEPS.map(([icon, title, text]) => h("li", glyph(icon), h("strong", title), text)),
      ),
      h("div.row", sampleButton("primary"), newButton("")),
      h("p", "The sample is a generated recording, made in some seconds. A guide leads through these steps."),
    ]);
  }

  const running = () =>
    app.state.jobs.filter((job) => OF_START.includes(job.kind) && isActive(job)).map(({ id }) => id);
  let before = running();
  function showJobs() {
    const now = running();
    const hasEnded = before.some((id) => !now.includes(id));
    before = now;
    if (hasEnded && !openSample()) void refresh();
  }

  app.state.on("jobs", showJobs, until);
  app.events.on("reconnected", refresh, until);
  void refresh();
}

/** The progress of reading boxes of recordings or of a file, or of a copy, or the reason why that failed. */
function importLine(/** @type {App} */ app, /** @type {string} */ project, /** @type {Set<string>} */ started) {
  return createJobLine(app, "import", () => {
    const own = jobsOf(app, project, ...OF_START);
    const isShown = own.length > 0 && (own[0].state === "failed" || started.has(own[0].id));
    return own.find(isActive) ?? (isShown ? own[0] : undefined);
  });
}

function card(
  /** @type {App} */ app,
  /** @type {Api.ProjectSummary} */ project,
  /** @type {Act} */ act,
  /** @type {HTMLElement} */ line,
) {
  const { name, problem } = project;
  const link = h("a", { href: makeHash(name, "annotate"), "data-testid": `open-${name}` }, name);
  const title = h("span.grow.ellipsis", h("h2.ellipsis", problem ? name : link));
  const isEmpty = project.recordings === 0;
  const next = nextStep(project);
  const others = project.classes.slice(NAMED);
  const addButton = button(
    [glyph("plus"), "Recording"],
    act(() => addRecordings(app, name)),
    {
      class: isEmpty ? "primary" : "",
      "data-testid": `add-recording-${name}`,
    },
  );
  const boxesButton = button(
    [glyph("plus"), "Boxes"],
    act(() => importBoxes(app, name)),
    {
      title: "Import 2D boxes on camera images, or 3D boxes as proposals or labels, from a file",
      "data-testid": `import-boxes-${name}`,
    },
  );
  const done = `${project.frames_done.toLocaleString("en")} of ${count(project.frames, "frame")} done`;
  const content = problem
    ? [h("p.error-box", problem)]
    : [
        h("p.classes", [
          project.classes.slice(0, NAMED).map((label) => h("span.chip", label)),
          others.length > 0 && h("span.chip", { title: others.join(", ") }, `+ ${others.length}`),
          iconButton(
            "edit",
            `Change the classes and attributes of ${name}`,
            act(() => editClasses(app, name)),
            {
              "data-testid": `edit-classes-${name}`,
            },
          ),
        ]),
        h(
          "p.number.muted",
          isEmpty ? "No recording yet: add one to begin." : `${count(project.recordings, "recording")}, ${done}`,
        ),
        !isEmpty &&
          h("progress", { max: project.frames || 1, value: project.frames_done, "aria-label": done, title: done }),
        !isEmpty && h("p.number.states", stateCounts(project.labels_by_state)),
        ...project.missing.map((recording) =>
          h("div.row.missing", [
            h("span.grow.bad", `${recording.name}: its folder was not found`),
            button(
              "Locate …",
              act(() => locateRecording(app, name, recording)),
              {
                "data-testid": `locate-${recording.name}`,
              },
            ),
          ]),
        ),
        line,
        h("div.row.next", next ? goOn(name, next) : addButton),
        !isEmpty && h("div.row", addButton, boxesButton),
      ];
  return h("section.panel.project", { "data-testid": `project-${name}`, "aria-label": name }, [
    !problem && picture(project),
    h("div.row", title, createMenu(app, project, act)),
    ...content,
  ]);
}

const goOn = (/** @type {string} */ name, /** @type {NonNullable<ReturnType<typeof nextStep>>} */ { mode, text }) =>
  h("a.button.primary-link", { href: makeHash(name, mode), "data-testid": `next-${name}` }, text);

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
  const attributes = { href: makeHash(name, "annotate"), tabindex: -1, "aria-hidden": "true" };
  const frame = h("a.picture", attributes, glyph("box"));
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

function stateCounts(/** @type {Record<string, number>} */ labels) {
  const known = STATES.filter((state) => labels[state] > 0);
  if (!known.length) return [h("span.muted", "no boxes yet")];
  return known.map((state) =>
    h("span", { class: `state-${state}` }, `${labels[state].toLocaleString("en")} ${state}`),
  );
}
