/** The panels of Review. */

import { h } from "../dom.js";
import { makeHash } from "../router.js";

/**
 * @param {string} project
 */
export function layout(project) {
  /**
   * @param {string} name
   * @param {string} label
   */
  const part = (name, label) => h("section", { class: `panel ${name}`, "aria-label": label });
  const queue = part("queue", "Queue");
  const boxes = part("frame-boxes", "Boxes of this frame");
  const imagePanel = part("image", "Camera image");
  const scene = part("scene", "3D view");
  const ortho = h("div", { class: "orthos", "data-testid": "orthos" });
  const fields = part("fields", "Selected box");
  const actions = h("div", { class: "actions", role: "toolbar", "aria-label": "Actions" });
  const saving = h("span", { class: "muted", role: "status", "data-testid": "saving" });
  const done = h(
    "div",
    { class: "done-note", hidden: true, role: "status", "data-testid": "review-done" },
    "No proposals left to review. ",
    h("a", { href: makeHash(project, "train") }, "Propose more"),
    " or ",
    h("a", { href: makeHash(project, "export") }, "export"),
    ".",
  );
  const root = h(
    "div",
    { class: "review" },
    h("div", { class: "side" }, queue, boxes),
    h("div", { class: "pictures" }, imagePanel, scene),
    h("div", { class: "bar" }, actions, done, saving),
    h("div", { class: "details" }, ortho, fields),
  );
  return { root, queue, boxes, image: imagePanel, scene, ortho, fields, actions, saving, done };
}

/** Shown in place of the panels if the project has no frame. */
export function emptyProject() {
  return h(
    "div",
    { class: "empty" },
    h("h2", {}, "There is nothing to review yet"),
    h("p", {}, "Add a recording to the project, label a few objects, and let the detectors propose the rest."),
    h("a", { class: "button", href: "#/" }, "Add a recording"),
  );
}
