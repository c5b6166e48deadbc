/** The class of the next box: that of the box that was selected last, or the one that was picked since. */

import { createClassPicker } from "../classes/picker.js";
import { h } from "../dom.js";

export function createNextClass(/** @type {HTMLElement} */ host, /** @type {ModeApp} */ app) {
  const buttons = createClassPicker(app, pick);
  host.append(h("header", h("h2.grow.ellipsis", "Class of the next box"), buttons.tools), buttons.root);
  /** @type {string | null} */
  let picked = null;

  // none while the project is being left
  const classes = () => /** @type {App} */ (app).state.project?.classes ?? [];

  /** The first class if the picked one was removed. */
  const label = () => (picked !== null && classes().includes(picked) ? picked : classes()[0]);

  function show() {
    if (classes().length) buttons.show(label());
  }

  function pick(/** @type {string} */ name) {
    picked = name;
    show();
  }

  return {
    get label() {
      return label();
    },
    pick,
    show,
  };
}
