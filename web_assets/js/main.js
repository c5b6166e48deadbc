/**
 * The page: creates the `app` object, which every mode gets, and mounts the mode given by the URL.
 *
 * A mode is a module with `mount(root, app, until)`, which may return a `Mounted`. A mode asks `app.mayLeave` before it
 * shows another frame.
 */

import { createApi, projectPath } from "./api.js";
import { askUnsaved, confirm, keyTableDialog } from "./dialogs.js";
import { button, elementById, h } from "./dom.js";
import { createEffort } from "./effort.js";
import { ApiError, isAborted, messageOf } from "./errors.js";
import { createEvents } from "./events.js";
import { errorBox } from "./forms.js";
import { createFrameState, createState } from "./frame_state.js";
import { mountGuide } from "./guide.js";
import { readJobs } from "./jobs.js";
import { createKeys } from "./keys.js";
import { showHints, toast } from "./messages.js";
import { makeHash, parseHash } from "./router.js";
import { signIn } from "./session.js";
import { readTimeline } from "./timeline/reading.js";
import { mountTimeline } from "./timeline/timeline.js";
import { applyTheme, mountTopbar } from "./topbar.js";
import { createViewport } from "./viewport.js";

const work = elementById("work");
/** @type {Mounted | null} */
let mounted = null;
/** Ends what the mounted mode listens to. */
let ending = new AbortController();
let visit = 0;
/** What the address names could not be opened. */
let isBroken = false;
/** @type {AbortController | null} */
let frameRequest = null;

const effort = createEffort();
const state = createState({
  operator: null,
  version: "",
  route: parseHash(""),
  project: null,
  frame: null,
  timeline: null,
  track: null,
  span: null,
  presence: {},
  jobs: [],
  connected: true,
});
/** @type {App} */
const app = {
  api: createApi(effort, () => signIn(app)),
  effort,
  events: createEvents(),
  get frames() {
    return frames;
  },
  keys: createKeys(),
  state,
  viewport: null,
  toast,
  go(hash) {
    if (location.hash === hash) void follow();
    else location.hash = hash;
  },
  path: (...parts) => projectPath(state.route.project ?? "", ...parts),
  refreshProject,
  loadFrame,
  mayLeave,
  stay: (frame) => comeBack({ ...state.route, frame }),
  undo: () => travel("undo"),
  redo: () => travel("redo"),
};
const frames = createFrameState(app);

async function refreshProject() {
  const name = app.state.route.project;
  if (name === null) return;
  const project = await app.api.get(projectPath(name));
  if (app.state.route.project === name) app.state.set({ project });
}

/**
 * Loads and opens a frame, or that of its moment in which a camera sees a label best. A newer call cancels older ones.
 */
async function loadFrame(/** @type {number} */ id, /** @type {string | null} */ bestFor = null) {
  frameRequest?.abort();
  frameRequest = new AbortController();
  try {
    const frame = await app.frames.open(id, bestFor, { signal: frameRequest.signal });
    app.events.openFrame(frame.frame.id);
    return frame;
  } catch (error) {
    if (!isAborted(error)) {
      // the previous frame must not be mistaken for this one
      app.events.openFrame(null);
      app.frames.close();
    }
    throw error;
  }
}

/** Saves the unsaved work of the mode. If something cannot be saved, the operator decides. */
async function mayLeave(/** @type {number | null} */ to = null) {
  await mounted?.flush?.();
  const find = () => mounted?.unsaved?.(to) ?? null;
  const unsaved = find();
  return unsaved === null || askUnsaved(unsaved, find);
}

function comeBack(/** @type {Omit<Route, "query">} */ { project, mode, frame }) {
  history.replaceState(null, "", project === null ? "#/" : makeHash(project, mode, frame));
  app.state.set({ route: parseHash(location.hash) });
}

/** Undo or redo. If others have changed the same box since, the operator may skip that step. */
async function travel(/** @type {"undo" | "redo"} */ direction, /** @type {boolean} */ skip = false) {
  const { mode, project } = app.state.route;
  if (project === null) return;
  try {
    if (!(await mayLeave())) return;
    app.effort.action();
    const { frame, state, done } = await app.api.change(app.path(direction), { skip });
    toast(`${direction === "undo" ? "Undone" : "Redone"}: ${done}`);
    if (frame === null || state === null) await refreshProject();
    else if (!app.frames.take(state) && mode === "annotate") app.go(makeHash(project, mode, frame));
  } catch (error) {
    if (!(error instanceof ApiError) || error.status !== 409) toast(error);
    else if (error.body.frame === undefined || skip) toast(error, "warn");
    else if (await confirm(`Cannot ${direction} this step`, error.message, `Skip it and ${direction} the one before`))
      await travel(direction, true);
  }
}

/**
 * Opens the frame anew if the up direction or the calibration of its recording has changed: its cloud lies elsewhere.
 */
async function readjust(/** @type {Messages["adjusted"]} */ { recording, operator }) {
  const { route, frame } = app.state;
  app.frames.miss();
  if (route.mode !== "annotate" || frame?.frame.recording !== recording) return;
  toast(`${operator} has changed this recording's calibration or which way is up.`);
  await follow(true);
}

/** Reads the project again; modes then show its classes, and read the frame again. */
function takeClasses(/** @type {Messages["classes"]} */ { operator }) {
  app.frames.miss();
  if (operator !== app.state.operator) toast(`${operator} has changed the project's classes or settings.`);
  void refreshProject();
}

/** Shows the same under the project's new name. What is not saved yet is saved there. */
async function rename(/** @type {Messages["renamed"]} */ { name, operator }) {
  const { mode, frame, query } = app.state.route;
  history.replaceState(null, "", makeHash(name, mode, frame, Object.fromEntries(query)));
  app.state.set({ route: parseHash(location.hash) });
  toast(`${operator} has renamed this project to ${name}.`);
  await refreshProject();
  await follow(true);
}

/** Leaves the frame if its recording was removed. */
async function reread(/** @type {Messages["recordings"]} */ { recording, operator }) {
  await refreshProject();
  const { route, frame, project } = app.state;
  const isThere = project?.recordings.some(({ id }) => id === recording);
  if (isThere || frame?.frame.recording !== recording) return;
  if (route.frame === null) {
    app.frames.close();
    return;
  }
  const text = operator ? `${operator} has removed this recording from` : "This recording was removed from";
  toast(`${text} the project.`, "warn");
  if (!(await mayLeave())) return;
  app.frames.close();
  comeBack({ ...route, frame: null });
  await follow(true);
}

/** Opens the frame anew if its recording was adjusted while there was no connection. Classes may have changed, too. */
async function catchUp() {
  const { route, frame } = app.state;
  await refreshProject();
  if (route.mode !== "annotate" || frame === null) return;
  const now = await app.api.get(app.path("frames", frame.frame.id));
  const isShown = app.state.route.project === route.project && app.state.frame?.frame.id === frame.frame.id;
  if (isShown && now.image.url !== frame.image.url) await follow(true);
}

/**
 * Mounts what the address names.
 *
 * @param {boolean} [isAnew] also if it is mounted already.
 */
async function follow(isAnew = false) {
  const ownVisit = ++visit;
  isBroken = false;
  const before = app.state.route;
  const route = parseHash(location.hash);
  const isSameMode =
    route.project === before.project && route.mode === before.mode && Boolean(mounted?.route) && !isAnew;
  if (!isSameMode && !(await mayLeave())) {
    if (ownVisit === visit) comeBack(before);
    return;
  }
  if (ownVisit !== visit) return;
  app.state.set({ route });
  if (isSameMode) {
    mounted?.route?.(route);
    return;
  }
  leave();
  if (route.project !== before.project) {
    frameRequest?.abort();
    app.frames.close(true);
    app.state.set({ project: null, presence: {} });
  }
  try {
    await app.events.follow(route.project);
    if (ownVisit !== visit) return;
    // the connection may be new
    if (app.state.project === null) {
      showJobs();
      await refreshProject();
    }
    const module = await loadMode(route.mode);
    if (ownVisit !== visit) return;
    work.replaceChildren();
    app.keys.setMode(route.mode);
    // time spent in other modes does not count for the next box
    app.effort.reset();
    document.title = route.project ? `${route.project} · ${route.mode} · annotator` : "annotator";
    ending = new AbortController();
    mounted = module.mount(work, /** @type {ModeApp} */ (app), ending.signal) ?? {};
  } catch (error) {
    if (ownVisit === visit) showProblem(error, route);
  }
}

/** The module of a mode has its name. @returns {Promise<Mode>} */
async function loadMode(/** @type {string} */ mode) {
  try {
    return await import(`./${mode}/${mode}.js`);
  } catch (error) {
    // says that the server does not respond, if that is the reason
    await app.api.get("/api/session");
    throw error;
  }
}

function leave() {
  const old = mounted;
  mounted = null;
  app.keys.setMode(null);
  ending.abort();
  old?.unmount?.();
  app.viewport?.detach();
  app.state.set({ track: null });
  work.className = "work";
  work.replaceChildren();
  showHints();
}

function showProblem(/** @type {unknown} */ error, /** @type {Route} */ route) {
  if (!(error instanceof ApiError)) console.error(error);
  isBroken = true;
  const isMissing = error instanceof ApiError && error.status === 404;
  // the server refuses a connection for a project that does not exist, which is no lost connection
  if (isMissing) void app.events.follow(null);
  const title = isMissing ? `There is no project '${route.project}'` : "This page could not be opened";
  work.replaceChildren(
    h("div.page", [
      h("h1", title),
      errorBox(error, "page-problem"),
      h("div.row", [
        button("Try again", () => follow(), { class: "primary" }),
        h("a.button", { href: "#/" }, "All projects"),
      ]),
    ]),
  );
}

/**
 * Removes the focus from a button that was pressed with the mouse, so that Space, Tab and Enter stay keys of the mode.
 */
function releaseMouseFocus(/** @type {MouseEvent} */ event) {
  if (event.detail === 0 || !(event.target instanceof Element) || event.target.closest("dialog")) return;
  event.target.closest("button")?.blur();
}

/** Reads the jobs. An error is not shown: the page works without the list, and events add the jobs later. */
function showJobs() {
  readJobs(app).catch((error) => console.debug(`jobs: ${messageOf(error)}`));
}

async function start() {
  const topbar = elementById("topbar");
  applyTheme();
  app.effort.watch(window);
  app.keys.listen(window);
  app.keys.register({
    undo: () => void app.undo(),
    redo: () => void app.redo(),
    help: () => void keyTableDialog(app.keys),
    regions: () => {
      const isInBar = topbar.contains(document.activeElement);
      const target = isInBar ? work : topbar.querySelector("nav a, a");
      if (target instanceof HTMLElement) target.focus();
    },
  });
  document.addEventListener("click", releaseMouseFocus);
  window.addEventListener("beforeunload", (event) => {
    // sent while the browser shows its question
    void mounted?.flush?.();
    if (mounted?.unsaved?.(null)) event.preventDefault();
  });
  // no part of the page need catch an error only to show it; those of the page itself are in the console, too
  window.addEventListener("unhandledrejection", (event) => {
    const { reason } = event;
    toast(reason instanceof Error ? reason : new Error(String(reason)));
    if (reason instanceof ApiError || isAborted(reason)) event.preventDefault();
  });
  // registered before all other listeners, so that events are recorded before the modes handle them
  app.events.on("frame", app.frames.hear);
  app.events.on("reconnected", app.frames.miss);
  app.events.on("still", app.frames.miss);
  app.events.on("presence", ({ frames }) => app.state.set({ presence: frames }));
  app.events.on("job", ({ job }) =>
    app.state.set({ jobs: [job, ...app.state.jobs.filter((other) => other.id !== job.id)] }),
  );
  app.events.on("adjusted", (message) => void readjust(message));
  app.events.on("classes", takeClasses);
  app.events.on("renamed", (message) => void rename(message));
  app.events.on("removed", ({ operator }) => {
    toast(`${operator} has removed this project.`, "warn");
    app.go("#/");
  });
  app.events.on("recordings", (message) => void reread(message));
  app.events.on("replaced", () =>
    toast("This project was replaced on the server. Reload the page: what it shows is no longer stored.", "error"),
  );
  app.events.on("reconnected", () => {
    showJobs();
    void (isBroken ? follow() : catchUp());
  });
  app.events.on("connection", (connected) => app.state.set({ connected }));
  readTimeline(app);
  mountTopbar(topbar, app);
  mountTimeline(elementById("timeline"), app);
  mountGuide(app);
  try {
    const session = await app.api.get("/api/session");
    app.state.set({ operator: session.operator, version: session.version });
    if (!session.operator) await signIn(app);
  } catch (error) {
    showProblem(error, app.state.route);
    return;
  }
  app.viewport = createViewport(app);
  window.addEventListener("hashchange", () => follow());
  // the operator may have created the project, or started the server, in another window
  window.addEventListener("focus", () => {
    if (isBroken) void follow();
  });
  await follow();
}

await start();
