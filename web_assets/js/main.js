/**
 * The page: makes the `app` object that every mode gets, and mounts the mode that the address names.
 *
 * A mode is a module with `mount(root, app) -> {unmount(), route?(route), flush?(), unsaved?()}`: `route` is called in place
 * of a new mount where only the frame or the query of the address changed; `flush` ends what is being saved; `unsaved` says
 * what would be lost, {text, retry(), discard()}, or null. A mode asks `mayLeave` before it shows another frame.
 *
 * app = {
 *   api, effort, events, keys, state, toast,
 *   viewport,                    js/viewport.js
 *   go(hash, given?),            follows an address (router.makeHash makes one)
 *   given,                       what the mode before has for the next one to begin with: {project, frame, image_box}, or null
 *   path(...parts),              the open project's resource: app.path("frames", 3)
 *   refreshProject(),            reads the project's summary again into state.project
 *   frames,                      js/frame_state.js: which state of the open frame is the newest
 *   loadFrame(id),               reads a frame into state.frame and tells the others that it is open here
 *   undo(), redo(),
 *   mayLeave(),                  saves; resolves to false where something cannot be saved, and the operator stays with it
 *   stay(frame),                 the address names again what is shown
 * }
 * state: operator, version, route, project, frame (FrameState), presence ({frame id: names}), jobs, connected.
 */

import { createApi, projectPath } from "./api.js";
import { askUnsaved, confirm, keyTableDialog } from "./dialogs.js";
import { h } from "./dom.js";
import { createEffort } from "./effort.js";
import { createEvents } from "./events.js";
import { createFrameState } from "./frame_state.js";
import { createKeys } from "./keys.js";
import { makeHash, parseHash } from "./router.js";
import { signIn } from "./session.js";
import { createState } from "./state.js";
import { applyTheme } from "./theme.js";
import { toast } from "./toasts.js";
import { mountTopbar } from "./topbar.js";
import { createViewport } from "./viewport.js";

const MODULES = {
  start: "./start/start.js",
  label: "./label/label.js",
  review: "./review/review.js",
  train: "./train/train.js",
  export: "./export/export.js",
  statistics: "./stats/stats.js",
  checks: "./checks/checks.js",
};

const work = document.getElementById("work");
const app = createApp();
let mounted = null;
let visit = 0;
let frame_request = null;

function createApp() {
  const effort = createEffort();
  const state = createState({ operator: null, version: "", route: parseHash(""), project: null, frame: null, presence: {}, jobs: [], connected: true });
  const made = { effort, state, toast, events: createEvents(), keys: createKeys(), viewport: null };
  made.api = createApi(effort, () => signIn(made));
  made.frames = createFrameState(made);
  return Object.assign(made, {
    given: null,
    go(hash, given = null) {
      made.given = given;
      if (location.hash === hash) void follow();
      else location.hash = hash;
    },
    path: (...parts) => projectPath(state.route.project, ...parts),
    refreshProject,
    loadFrame,
    mayLeave,
    stay: (frame) => comeBack({ ...state.route, frame }),
    undo: () => travel("undo"),
    redo: () => travel("redo"),
  });
}

async function refreshProject() {
  const name = app.state.route.project;
  if (name === null) return;
  const project = await app.api.get(projectPath(name));
  if (app.state.route.project === name) app.state.set({ project });
}

/** The newest call wins: the answer to an older one is dropped. */
async function loadFrame(id) {
  frame_request?.abort();
  frame_request = new AbortController();
  try {
    const frame = await app.frames.open(id, { signal: frame_request.signal });
    app.events.openFrame(id);
    return frame;
  } catch (error) {
    if (error.name !== "AbortError") {
      // what is shown must not be taken for it
      app.events.openFrame(null);
      app.frames.close();
    }
    throw error;
  }
}

/** Saves what the mode has open. Where something cannot be saved, the operator says what becomes of it. */
async function mayLeave() {
  await mounted?.flush?.();
  const unsaved = mounted?.unsaved?.() ?? null;
  return unsaved === null || askUnsaved(unsaved, () => mounted?.unsaved?.() ?? null);
}

function comeBack({ project, mode, frame }) {
  // the mode that it was for is not opened
  app.given = null;
  history.replaceState(null, "", project === null ? "#/" : makeHash(project, mode, frame));
  app.state.set({ route: parseHash(location.hash) });
}

/** Undo or redo; where somebody else has changed the same since, the operator may pass over that step. */
async function travel(direction, skip = false) {
  if (app.state.route.project === null) return;
  try {
    if (!(await mayLeave())) return;
    app.effort.action();
    const { frame, state, done } = await app.api.change(app.path(direction), { skip });
    toast(`${direction === "undo" ? "Undone" : "Done again"}: ${done}`);
    const { mode, project } = app.state.route;
    if (app.state.frame?.frame.id === frame) app.frames.take(state);
    else if (mode === "label" || mode === "review") app.go(makeHash(project, mode, frame));
  } catch (error) {
    if (error.status !== 409) toast(error);
    else if (error.body.frame === undefined || skip) toast(error, "warn");
    else if (await confirm("This cannot be taken back any more", error.message, `Skip it and ${direction} the step before`)) await travel(direction, true);
  }
}

/** Mounts what the address names. */
async function follow() {
  const own_visit = ++visit;
  const before = app.state.route;
  const route = parseHash(location.hash);
  const is_same_mode = route.project === before.project && route.mode === before.mode && Boolean(mounted?.route);
  if (!is_same_mode && !(await mayLeave())) {
    if (own_visit === visit) comeBack(before);
    return;
  }
  if (own_visit !== visit) return;
  app.state.set({ route });
  if (route.project !== before.project) {
    frame_request?.abort();
    app.frames.close(true);
    app.state.set({ project: null, presence: {} });
    app.events.follow(route.project);
  }
  if (is_same_mode) {
    mounted.route(route);
    return;
  }
  leave();
  try {
    if (route.project !== null && app.state.project === null) await refreshProject();
    const module = await import(MODULES[route.mode]);
    if (own_visit !== visit) return;
    work.replaceChildren();
    app.keys.setMode(route.mode);
    // What was done on other pages is not the cost of the next box.
    app.effort.reset();
    document.title = route.project ? `${route.project} · ${route.mode} · annotator` : "annotator";
    mounted = module.mount(work, app) ?? null;
  } catch (error) {
    if (own_visit === visit) showProblem(error, route);
  }
}

function leave() {
  const old = mounted;
  mounted = null;
  app.keys.setMode(null);
  old?.unmount();
  app.viewport?.detach();
  work.className = "work";
  work.replaceChildren();
}

function showProblem(error, route) {
  if (error.name !== "ApiError") console.error(error);
  const retry = h("button", { type: "button", class: "primary", onclick: () => follow() }, "Try again");
  const back = h("a", { class: "button", href: "#/" }, "All projects");
  const title = error.status === 404 ? `There is no project '${route.project}'` : "This page could not be opened";
  work.replaceChildren(h("div", { class: "page" }, h("h1", {}, title), h("p", { class: "error-box", role: "alert", "data-testid": "page-problem" }, error.message), h("div", { class: "row" }, retry, back)));
}

/** A button pressed with the mouse keeps no focus, so that Space, Tab and Enter go on being the mode's. */
function releaseMouseFocus(event) {
  if (event.detail > 0 && event.target.closest("button") && !event.target.closest("dialog")) event.target.closest("button").blur();
}

async function start() {
  applyTheme();
  app.effort.watch(window);
  app.keys.listen(window);
  app.keys.register({
    undo: () => void app.undo(),
    redo: () => void app.redo(),
    help: () => void keyTableDialog(app.keys),
    regions: () => {
      const in_bar = document.activeElement?.closest("#topbar");
      (in_bar ? work : document.querySelector("#topbar nav a, #topbar a"))?.focus();
    },
  });
  document.addEventListener("click", releaseMouseFocus);
  window.addEventListener("beforeunload", (event) => {
    // what can still be sent is on its way while the browser asks
    void mounted?.flush?.();
    if (mounted?.unsaved?.()) event.preventDefault();
  });
  window.addEventListener("unhandledrejection", ({ reason }) => {
    if (reason?.name !== "AbortError") toast(reason instanceof Error ? reason : new Error(String(reason)));
  });
  // before any mode listens: it then finds what was told
  app.events.on("frame", app.frames.hear);
  app.events.on("reconnected", app.frames.miss);
  app.events.on("presence", ({ frames }) => app.state.set({ presence: frames }));
  app.events.on("job", ({ job }) => app.state.set({ jobs: [job, ...app.state.jobs.filter((other) => other.id !== job.id)] }));
  app.events.on("connection", (connected) => app.state.set({ connected }));
  mountTopbar(document.getElementById("topbar"), app);
  try {
    const session = await app.api.get("/api/session");
    app.state.set({ operator: session.operator, version: session.version });
    if (!session.operator) await signIn(app);
  } catch (error) {
    showProblem(error, app.state.route);
    return;
  }
  app.viewport = createViewport(app);
  app.api.get("/api/jobs").then(({ jobs }) => app.state.set({ jobs }), () => {});
  window.addEventListener("hashchange", follow);
  await follow();
}

await start();
