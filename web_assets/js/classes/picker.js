/** The choice of a class: buttons for a few, and a list of all with a search, those that are used most first. */

import { classColor } from "../colors.js";
import { CANCEL, openDialog } from "../dialogs.js";
import { button, h, iconButton, patch } from "../dom.js";
import { editClasses } from "./classes.js";

/** Up to so many classes are all shown; of more, so few. */
const [ALL, FEW] = [9, 4];

/** The classes whose names contain what was typed: those that begin with it first, else in their order. */
export function matching(/** @type {string[]} */ names, /** @type {string} */ typed) {
  const wanted = typed.trim().toLowerCase();
  const found = names.filter((name) => name.toLowerCase().includes(wanted));
  const begins = (/** @type {string} */ name) => Number(name.toLowerCase().startsWith(wanted));
  return found.sort((a, b) => begins(b) - begins(a));
}

/** The project's classes, those with most boxes first. */
async function byUse(/** @type {ModeApp} */ app) {
  const { classes } = await app.api.get(app.path("classes"));
  return classes.sort((a, b) => b.labels + b.boxes_2d - a.labels - a.boxes_2d).map(({ name }) => name);
}

function swatchOf(/** @type {ModeApp} */ app, /** @type {string} */ label) {
  const swatch = h("span.swatch");
  swatch.style.background = classColor(app.state.project, label);
  return swatch;
}

/** The digit that chooses a class. */
function digitOf(/** @type {ModeApp} */ app, /** @type {string} */ label) {
  const index = app.state.project.classes.indexOf(label);
  return index < 9 ? h("kbd", String(index + 1)) : null;
}

/** Asks for one of the classes; null if none was chosen. Enter takes the first of those that are found. */
export async function askClass(/** @type {ModeApp} */ app) {
  const names = await byUse(app);
  let found = names;
  const list = h("ul.class-list", { "data-testid": "class-list" });
  const field = h("input", {
    type: "search",
    "aria-label": "Search a class",
    placeholder: "Search",
    autofocus: true,
    autocomplete: "off",
    "data-testid": "class-search",
    oninput: show,
  });
  /** @type {string | null} */
  let clicked = null;
  function show() {
    found = matching(names, field.value);
    const rows = found.map((name) => {
      const choose = (/** @type {MouseEvent} */ { currentTarget }) => {
        clicked = name;
        /** @type {HTMLButtonElement} */ (currentTarget).form?.requestSubmit();
      };
      const content = [swatchOf(app, name), h("span.ellipsis.grow", name), digitOf(app, name)];
      return h("li", { "data-key": name }, button(content, choose, { class: "quiet row-button" }));
    });
    patch(list, rows.length ? rows : h("li.muted.pad", "No class has this in its name."));
  }
  show();
  return openDialog({
    title: "Class",
    testid: "class-dialog",
    content: [field, list],
    actions: [CANCEL, { label: "Choose", value: "choose" }],
    submit: () => clicked ?? found[0] ?? null,
  });
}

/**
 * The class of the next box, that of the box that was selected last, or the one that was picked since: buttons for the
 * classes; the digit keys do the same. Two tools show all of many, and change them.
 */
export function createNextClass(/** @type {HTMLElement} */ host, /** @type {ModeApp} */ app) {
  const root = h("div.class-picker", { role: "radiogroup", "aria-label": "Class" });
  const more = button([], () => void ask(), { "data-testid": "all-classes", title: "Choose from all classes (/)" });
  const change = () => editClasses(app, app.state.project.name);
  const edit = iconButton("edit", "Change the classes and attributes", change, { "data-testid": "edit-classes" });
  host.append(h("header", h("h2.grow.ellipsis", "Class of the next box"), more, edit), root);
  /** The classes by their use when the mode was opened; those that came later are last. @type {string[]} */
  let used = [];
  /** @type {string | null} */
  let picked = null;
  if (app.state.project.classes.length > ALL) void readUse();

  async function readUse() {
    used = await byUse(app);
    show();
  }

  // none while the project is being left
  const classesNow = () => /** @type {App} */ (app).state.project?.classes ?? [];

  /** The first class if the picked one was removed. */
  const label = () => (picked !== null && classesNow().includes(picked) ? picked : classesNow()[0]);

  async function ask() {
    const name = await askClass(app);
    if (name !== null) pick(name);
  }

  function pick(/** @type {string} */ name) {
    picked = name;
    show();
  }

  function show() {
    const classes = classesNow();
    const current = label();
    if (current === undefined) return;
    const isMany = classes.length > ALL;
    const known = used.filter((name) => classes.includes(name));
    const few = isMany ? [...new Set([...known, ...classes])].slice(0, FEW) : classes;
    const shown = !isMany || few.includes(current) ? few : [...few.slice(0, FEW - 1), current];
    const buttons = shown.map((name) =>
      button([swatchOf(app, name), h("span.ellipsis", name), digitOf(app, name)], () => pick(name), {
        role: "radio",
        "aria-checked": String(name === current),
        "data-testid": `class-${name}`,
        "data-key": name,
      }),
    );
    patch(root, buttons);
    more.hidden = !isMany;
    patch(more, `+ ${classes.length - shown.length}`, h("kbd", "/"));
  }

  return {
    get label() {
      return label();
    },
    pick,
    show,
  };
}
