/**
 * The bar at the top: project, modes, recording, frame and camera (where.js), connection, job, undo and redo, theme, keys,
 * operator.
 */

import { confirm, keyTableDialog } from "./dialogs.js";
import { button, h, iconButton, patch } from "./dom.js";
import { isActive, NAMES, OF_START, showProgress, waiting } from "./jobs.js";
import { makeHash, MODES } from "./router.js";
import { signOut } from "./session.js";
import { createWhere, WITH_FRAME } from "./where.js";

export function mountTopbar(/** @type {HTMLElement} */ root, /** @type {App} */ app) {
  const where = createWhere(app);

  function show() {
    const logo = h("img", { src: "/assets/icon.svg", alt: "" });
    const brand = h("a.brand", { href: "#/", title: "All projects", "data-testid": "home" }, logo, "annotator");
    const lost = app.state.connected ? "" : "no connection, trying again …";
    const offline = h("span.offline", { role: "status", "data-key": "offline" }, lost);
    patch(root, brand, tabs(app), where, h("span.grow"), offline, job(app), history(app), tools(app, show));
  }

  for (const what of /** @type {const} */ (["connected", "route", "frame", "jobs", "operator"]))
    app.state.on(what, show);
  show();
}

function tabs(/** @type {App} */ app) {
  const { mode: current, project: name } = app.state.route;
  const frame = app.state.frame?.frame.id ?? null;
  const links = MODES.map((mode) => {
    const label = `${mode[0].toUpperCase()}${mode.slice(1)}`;
    const href = makeHash(name ?? "", mode, WITH_FRAME.has(mode) ? frame : null);
    return h("a", { href, "aria-current": mode === current ? "page" : null, "data-testid": `mode-${mode}` }, label);
  });
  const project = h("span.project.ellipsis", { title: name }, name);
  return h("div.row.where", { hidden: name === null, "data-key": "tabs" }, [
    h("span.divider"),
    project,
    h("nav", { "aria-label": "Modes" }, links),
  ]);
}

function history(/** @type {App} */ app) {
  const known = app.state.frame?.history;
  const step = (/** @type {"undo" | "redo"} */ id, /** @type {string} */ verb, /** @type {string} */ key) => {
    const label = `${verb}${known?.[id] ? `: ${known[id]}` : ""} (${key})`;
    return iconButton(id, label, () => app[id](), { disabled: known && !known[id], "data-testid": id });
  };
  const attributes = { role: "group", "aria-label": "History", "data-key": "history" };
  return h("div.row", { ...attributes, hidden: app.state.route.project === null }, [
    step("undo", "Undo", "Ctrl+Z"),
    step("redo", "Redo", "Ctrl+Shift+Z"),
  ]);
}

/** The running job, or the first one that waits. */
function job(/** @type {App} */ app) {
  const { jobs } = app.state;
  const shown = jobs.find(({ state }) => state === "running") ?? jobs.find(isActive);
  if (!shown) return null;
  const { kind, project, state, stage } = shown;
  const isQueued = state === "queued";
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  showProgress(bar, shown);
  const href = OF_START.includes(kind) ? "#/" : makeHash(project, kind === "export" ? "export" : "train");
  const title = `${NAMES[kind]} in ${project}: ${isQueued ? waiting(shown, jobs) : stage}`;
  const text = h("span", isQueued ? `${NAMES[kind]} waits` : NAMES[kind]);
  return h("a.jobs", { href, title, "data-key": "job", "data-testid": "job-indicator" }, text, bar);
}

function tools(/** @type {App} */ app, /** @type {() => void} */ show) {
  const { operator } = app.state;
  const change = () => {
    switchTheme();
    show();
  };
  const leave = async () => {
    const text = `You are signed in as ${operator}. Everything is saved.`;
    if (await confirm("Sign out", text, "Sign out")) await signOut(app);
  };
  return h("div.row", { "data-key": "tools" }, [
    iconButton("theme", `Theme: ${currentTheme()}`, change, { "data-testid": "theme" }),
    iconButton("help", "Keys (?)", () => keyTableDialog(app.keys), { "data-testid": "help" }),
    operator && button(operator, leave, { class: "quiet", title: "Sign out", "data-testid": "operator" }),
  ]);
}

// -- dark, light, or the system's choice; kept in this browser

const ORDER = ["system", "dark", "light"];

function currentTheme() {
  const kept = localStorage.getItem("theme");
  return kept !== null && ORDER.includes(kept) ? kept : "system";
}

export function applyTheme(theme = currentTheme()) {
  if (theme === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}

function switchTheme() {
  const next = ORDER[(ORDER.indexOf(currentTheme()) + 1) % ORDER.length];
  localStorage.setItem("theme", next);
  applyTheme(next);
}
