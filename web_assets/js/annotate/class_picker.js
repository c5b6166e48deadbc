/** Buttons for the class of the next box; the digit keys do the same. The last button changes the classes. */

import { editClasses } from "../classes/classes.js";
import { classColor } from "../colors.js";
import { button, h, iconButton, patch } from "../dom.js";

export function createClassPicker(/** @type {HTMLElement} */ host, /** @type {ModeApp} */ app) {
  const project = app.state.route.project;
  const root = h("div", { class: "classes", role: "radiogroup", "aria-label": "Class of the next box" });
  host.append(h("header", {}, h("h2", {}, "Class of the next box")), root);
  /** @type {string | null} */
  let picked = null;

  /** None while the project is being left. */
  const classes = () => /** @type {App} */ (app).state.project?.classes ?? [];

  function show() {
    patch(
      root,
      classes().map((label, index) => {
        const swatch = h("span", { class: "swatch" });
        swatch.style.background = classColor(app.state.project, label);
        const digit = index < 9 ? h("kbd", {}, String(index + 1)) : null;
        return button([swatch, label, digit], () => pick(label), {
          role: "radio",
          "aria-checked": String(label === picker.label),
          "data-testid": `class-${label}`,
        });
      }),
      iconButton("edit", "Change the classes and attributes", () => editClasses(app, project), {
        "data-testid": "edit-classes",
      }),
    );
  }

  function pick(/** @type {string} */ name) {
    picked = name;
    show();
  }

  const picker = {
    /** The class that was picked, or that of the box that was selected last; the first one if it was removed. */
    get label() {
      return picked !== null && classes().includes(picked) ? picked : classes()[0];
    },
    pick,
    show,
  };
  return picker;
}
