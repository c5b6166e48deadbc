/** The dialog that creates a project. */

import { openDialog } from "../dialogs.js";
import { h } from "../dom.js";

const ROTATIONS = [
  ["auto", "Automatic", "Upright where the recording has an up direction, free elsewhere."],
  ["upright", "Upright", "Boxes turn only about the vertical: people, cars, furniture."],
  ["free", "Free", "Boxes turn in any direction: hands, tools, parts in a bin."],
];

/**
 * Asks for name, classes and rotation. Returns the project's summary, or null if the dialog was cancelled.
 *
 * @param {App} app
 */
export function createProject(app) {
  const name = h("input", {
    name: "name",
    required: true,
    maxlength: 64,
    autofocus: true,
    placeholder: "street-hands",
    autocomplete: "off",
    "data-testid": "project-name",
  });
  const classes = h("input", {
    name: "classes",
    required: true,
    placeholder: "hand, cup",
    autocomplete: "off",
    "data-testid": "project-classes",
  });
  const choices = ROTATIONS.map(([value, title, help]) =>
    h(
      "label",
      { class: "choice" },
      h("input", {
        type: "radio",
        name: "rotation",
        value,
        checked: value === "auto",
        "data-testid": `rotation-${value}`,
      }),
      h("span", {}, h("strong", {}, title), h("span", { class: "help" }, help)),
    ),
  );
  return openDialog({
    title: "New project",
    testid: "new-project-dialog",
    content: [
      h(
        "label",
        { class: "field" },
        h("span", {}, "Name"),
        name,
        h("span", { class: "help" }, "Letters, digits, '-' and '_'. The project's folder gets this name."),
      ),
      h(
        "label",
        { class: "field" },
        h("span", {}, "Classes"),
        classes,
        h(
          "span",
          { class: "help" },
          "Separated by commas. The first nine get the keys 1 to 9. You can add more later.",
        ),
      ),
      h("fieldset", { class: "choices" }, h("legend", { class: "field-label" }, "Rotation of boxes"), choices),
    ],
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: "Create", value: "create" },
    ],
    async submit(value, form) {
      if (value === "cancel") return null;
      const labels = classes.value
        .split(",")
        .map((text) => text.trim())
        .filter(Boolean);
      if (!name.value.trim()) throw new Error("Please give the project a name.");
      if (!labels.length) throw new Error("Please name at least one class: the kind of object that you label.");
      const rotation = new FormData(form).get("rotation");
      return app.api.post("/api/projects", { name: name.value.trim(), classes: labels, rotation });
    },
  });
}
