/**
 * The bar at the top: project, modes, recording, frame and camera (where.js), connection, job, undo and redo, theme, keys,
 * operator.
 */

import { confirm, keyTableDialog } from "./dialogs.js";
import { h, iconButton, patch } from "./dom.js";
import { NAMES, waiting } from "./jobs.js";
import { makeHash } from "./router.js";
import { signOut } from "./session.js";
import { createWhere, WITH_FRAME } from "./where.js";

const TABS = [
  ["annotate", "Annotate"],
  ["train", "Train"],
  ["export", "Export"],
  ["statistics", "Statistics"],
  ["checks", "Checks"],
  ["alignment", "Alignment"],
];

export function mountTopbar(/** @type {HTMLElement} */ root, /** @type {App} */ app) {
  const parts = [
    brand(),
    tabs(app),
    createWhere(app),
    h("span.grow"),
    connection(app),
    jobs(app),
    history(app),
    tools(app),
  ];
  root.replaceChildren(...parts);
}

function brand() {
  return h(
    "a.brand",
    { href: "#/", title: "All projects", "data-testid": "home" },
    h("img", { src: "/assets/icon.svg", alt: "" }),
    "annotator",
  );
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
    patch(
      nav,
      TABS.map(([mode, label]) => {
        const href = makeHash(name, mode, WITH_FRAME.has(mode) ? frame : null);
        return h(
          "a",
          { href, "aria-current": mode === current ? "page" : null, "data-testid": `mode-${mode}` },
          label,
        );
      }),
    );
  };
  app.state.on("route", show);
  app.state.on("frame", show);
  show();
  return box;
}

function history(/** @type {App} */ app) {
  const undo = iconButton("undo", "Undo (Ctrl+Z)", () => app.undo(), { "data-testid": "undo" });
  const redo = iconButton("redo", "Redo (Ctrl+Shift+Z)", () => app.redo(), { "data-testid": "redo" });
  const box = h("div.row", { role: "group", "aria-label": "History" }, undo, redo);
  const show = () => {
    box.hidden = app.state.route.project === null;
    const known = app.state.frame?.history;
    describe(undo, "Undo", "Ctrl+Z", known?.undo);
    describe(redo, "Redo", "Ctrl+Shift+Z", known?.redo);
    undo.disabled = known !== undefined && !known.undo;
    redo.disabled = known !== undefined && !known.redo;
  };
  app.state.on("route", show);
  app.state.on("frame", show);
  show();
  return box;
}

function describe(
  /** @type {HTMLElement} */ button,
  /** @type {string} */ verb,
  /** @type {string} */ key,
  /** @type {string | null | undefined} */ what,
) {
  const text = what ? `${verb}: ${what} (${key})` : `${verb} (${key})`;
  button.title = text;
  button.setAttribute("aria-label", text);
}

function connection(/** @type {App} */ app) {
  const note = h("span.offline", { role: "status" });
  app.state.on("connected", (connected) => (note.textContent = connected ? "" : "no connection, trying again …"));
  return note;
}

/** The running job, or the first one that waits. */
function jobs(/** @type {App} */ app) {
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const text = h("span");
  const link = h("a.jobs", { "data-testid": "job-indicator" }, text, bar);
  const show = () => {
    const running =
      app.state.jobs.find(({ state }) => state === "running") ??
      app.state.jobs.find(({ state }) => state === "queued");
    link.hidden = !running;
    if (!running) return;
    const mode = running.kind === "export" ? "export" : "train";
    link.href = ["import", "copy", "sample"].includes(running.kind) ? "#/" : makeHash(running.project, mode);
    const isQueued = running.state === "queued";
    link.title = `${NAMES[running.kind]} in ${running.project}: ${isQueued ? waiting(running, app.state.jobs) : running.stage}`;
    text.textContent = isQueued ? `${NAMES[running.kind]} waits` : NAMES[running.kind];
    if (running.total > 0) bar.value = running.done / running.total;
    else bar.removeAttribute("value");
  };
  app.state.on("jobs", show);
  show();
  return link;
}

function tools(/** @type {App} */ app) {
  const theme = iconButton("theme", "", () => showTheme(switchTheme()), { "data-testid": "theme" });
  const showTheme = (/** @type {string} */ name) => {
    theme.title = `Theme: ${name}`;
    theme.setAttribute("aria-label", theme.title);
  };
  showTheme(currentTheme());
  const help = iconButton("help", "Keys (?)", () => keyTableDialog(app.keys), { "data-testid": "help" });
  const operator = h("button", {
    type: "button",
    class: "quiet",
    title: "Sign out",
    "data-testid": "operator",
    onclick: () => leave(app),
  });
  app.state.on("operator", (name) => {
    operator.textContent = name ?? "";
    operator.hidden = !name;
  });
  operator.hidden = true;
  return h("div.row", theme, help, operator);
}

async function leave(/** @type {App} */ app) {
  if (await confirm("Sign out", `You are signed in as ${app.state.operator}. Everything is saved.`, "Sign out"))
    await signOut(app);
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
