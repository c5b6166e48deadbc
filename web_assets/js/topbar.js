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
  const logo = h("img", { src: "/assets/icon.svg", alt: "" });
  const brand = h("a.brand", { href: "#/", title: "All projects", "data-testid": "home" }, logo, "annotator");
  const offline = h("span.offline", { role: "status" });
  app.state.on("connected", (connected) => {
    offline.textContent = connected ? "" : "no connection, trying again …";
  });
  const where = createWhere(app);
  root.replaceChildren(brand, tabs(app), where, h("span.grow"), offline, jobs(app), history(app), tools(app));
}

function tabs(/** @type {App} */ app) {
  const project = h("span.project.ellipsis");
  const nav = h("nav", { "aria-label": "Modes" });
  const box = h("div.row.where", h("span.divider"), project, nav);
  const show = () => {
    const { mode: current, project: name } = app.state.route;
    box.hidden = name === null;
    if (name === null) return;
    project.textContent = name;
    project.title = name;
    const frame = app.state.frame?.frame.id ?? null;
    const links = MODES.map((mode) => {
      const label = `${mode[0].toUpperCase()}${mode.slice(1)}`;
      const href = makeHash(name, mode, WITH_FRAME.has(mode) ? frame : null);
      return h("a", { href, "aria-current": mode === current ? "page" : null, "data-testid": `mode-${mode}` }, label);
    });
    patch(nav, links);
  };
  app.state.on("route", show);
  app.state.on("frame", show);
  show();
  return box;
}

function history(/** @type {App} */ app) {
  const box = h("div.row", { role: "group", "aria-label": "History" });
  const show = () => {
    box.hidden = app.state.route.project === null;
    const known = app.state.frame?.history;
    const step = (/** @type {"undo" | "redo"} */ id, /** @type {string} */ verb, /** @type {string} */ key) => {
      const label = `${verb}${known?.[id] ? `: ${known[id]}` : ""} (${key})`;
      return iconButton(id, label, () => app[id](), { disabled: known && !known[id], "data-testid": id });
    };
    patch(box, step("undo", "Undo", "Ctrl+Z"), step("redo", "Redo", "Ctrl+Shift+Z"));
  };
  app.state.on("route", show);
  app.state.on("frame", show);
  show();
  return box;
}

/** Gives an icon another tooltip and accessible name. */
function entitle(/** @type {HTMLElement} */ icon, /** @type {string} */ text) {
  icon.title = text;
  icon.setAttribute("aria-label", text);
}

/** The running job, or the first one that waits. */
function jobs(/** @type {App} */ app) {
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const text = h("span");
  const link = h("a.jobs", { "data-testid": "job-indicator" }, text, bar);
  const show = () => {
    const { jobs: all } = app.state;
    const job = all.find(({ state }) => state === "running") ?? all.find(isActive);
    link.hidden = !job;
    if (!job) return;
    const { kind, project, state, stage } = job;
    const isQueued = state === "queued";
    link.href = OF_START.includes(kind) ? "#/" : makeHash(project, kind === "export" ? "export" : "train");
    link.title = `${NAMES[kind]} in ${project}: ${isQueued ? waiting(job, all) : stage}`;
    text.textContent = isQueued ? `${NAMES[kind]} waits` : NAMES[kind];
    showProgress(bar, job);
  };
  app.state.on("jobs", show);
  show();
  return link;
}

function tools(/** @type {App} */ app) {
  const theme = iconButton("theme", "", () => entitle(theme, `Theme: ${switchTheme()}`), { "data-testid": "theme" });
  entitle(theme, `Theme: ${currentTheme()}`);
  const help = iconButton("help", "Keys (?)", () => keyTableDialog(app.keys), { "data-testid": "help" });
  const operator = button("", leave, { class: "quiet", title: "Sign out", hidden: true, "data-testid": "operator" });
  app.state.on("operator", (name) => {
    operator.textContent = name ?? "";
    operator.hidden = !name;
  });

  async function leave() {
    const text = `You are signed in as ${app.state.operator}. Everything is saved.`;
    if (await confirm("Sign out", text, "Sign out")) await signOut(app);
  }

  return h("div.row", theme, help, operator);
}

// -- dark, light, or the system's choice; kept in this browser

const ORDER = ["system", "dark", "light"];

export function currentTheme() {
  const kept = localStorage.getItem("theme");
  return kept !== null && ORDER.includes(kept) ? kept : "system";
}

export function applyTheme(theme = currentTheme()) {
  if (theme === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}

/** Switches to the next of the three; returns its name. */
export function switchTheme() {
  const next = ORDER[(ORDER.indexOf(currentTheme()) + 1) % ORDER.length];
  localStorage.setItem("theme", next);
  applyTheme(next);
  return next;
}
