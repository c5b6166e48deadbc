/** What becomes of classes of labels that a project does not have: one of its own, a new one, or nothing. */

import { projectPath } from "../api.js";
import { CANCEL, openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { select } from "../forms.js";

/** Values of a choice beside the project's classes; these have at least one character. */
const LEAVE_OUT = "";
const ADD = "\n";

/** What spellings of a class differ in is left out: case, spaces, `-` and `_`. */
const folded = (/** @type {string} */ name) => name.toLowerCase().replace(/[ _-]/g, "");

/** The class of the same name in another spelling, if there is one. */
export const alike = (/** @type {string[]} */ classes, /** @type {string} */ label) =>
  classes.find((known) => folded(known) === folded(label));

/**
 * The choices for the classes of boxes; those that the project has by the same name need none.
 *
 * @param {App} app
 * @param {Api.ProjectInfo} project
 * @param {boolean} areAdded whether a class is added, if nothing else is chosen.
 */
export function createClassChoice(app, { name, classes }, areAdded) {
  /** @type {Map<string, HTMLSelectElement>} */
  const choices = new Map();
  /** @type {string[]} */
  let labels = [];
  const root = h("fieldset.choices", { hidden: true, "data-testid": "boxes-classes" });

  function choice(/** @type {string} */ label) {
    const known = classes.map((each) => [each, `are ${each}`]);
    return select(
      [[LEAVE_OUT, "leave out"], ...known, [ADD, `add the class ${label}`]],
      { "aria-label": `Class for ${label}`, "data-testid": `boxes-class-${label}` },
      alike(classes, label) ?? (areAdded ? ADD : LEAVE_OUT),
    );
  }

  return {
    root,
    /** Asks about the classes of some boxes, with the number of each. */
    show(/** @type {Record<string, number>} */ boxes) {
      labels = Object.keys(boxes);
      const unknown = labels.filter((label) => !classes.includes(label));
      root.hidden = unknown.length === 0;
      for (const label of unknown) if (!choices.has(label)) choices.set(label, choice(label));
      root.replaceChildren(
        h("legend.field-label", "Classes that the project does not have"),
        ...unknown.map((label) =>
          h("label.row", h("span.grow.ellipsis", `${label} (${count(boxes[label], "box")})`), choices.get(label)),
        ),
      );
    },
    /** Adds classes as chosen. Returns the project's class of each other name; "" leaves its boxes out. */
    async take() {
      const values = labels.map((label) => /** @type {const} */ ([label, choices.get(label)?.value ?? label]));
      if (labels.length && values.every(([, value]) => value === LEAVE_OUT))
        throw new Error("All classes are left out. Choose one of the project's.");
      const wanted = values.flatMap(([label, value]) => (value === ADD ? [label] : []));
      if (wanted.length) {
        // an earlier try may have added some
        const present = await app.api.get(projectPath(name));
        const added = wanted.filter((label) => !present.classes.includes(label));
        if (added.length) await app.api.patch(projectPath(name), { classes: [...present.classes, ...added] });
      }
      const named = values.map(([label, value]) => [label, value === ADD ? label : value]);
      return Object.fromEntries(named.filter(([label, value]) => label !== value || wanted.includes(label)));
    },
  };
}

/**
 * Asks about the classes that an import of recorded boxes left out. Returns the job that imports these boxes, or null.
 *
 * @returns {Promise<Api.Job | null>}
 */
export async function importLeftOut(/** @type {App} */ app, /** @type {Api.Job} */ { project, result }) {
  const { unknown, recordings } = /** @type {ImportResult} */ (result);
  const choice = createClassChoice(app, await app.api.get(projectPath(project)), true);
  choice.show(unknown);
  return openDialog({
    title: "Classes of the boxes that were left out",
    testid: "left-out-dialog",
    content: [choice.root],
    actions: [CANCEL, { label: "Import", value: "import" }],
    async submit() {
      const names = await choice.take();
      return app.api.post(projectPath(project, "jobs"), { kind: "import", recordings, names });
    },
  });
}
