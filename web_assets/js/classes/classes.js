/** The dialog of a project's classes and attributes. Each change is saved at once, for everybody. */

import { projectPath } from "../api.js";
import { classColor } from "../colors.js";
import { openDialog } from "../dialogs.js";
import { button, count, h, iconButton, patch } from "../dom.js";
import { errorBox, onEnter, showProblem } from "../forms.js";
import { askMerge, askRemove, askRemoveAttribute, askRename, boxesOf } from "./asking.js";
import { attributeForm, describe } from "./attribute_form.js";

/** Shows the classes and attributes of a project until it is closed. */
export async function editClasses(/** @type {App} */ app, /** @type {string} */ project) {
  const path = projectPath(project, "classes");
  const problem = errorBox(null, "classes-problem");
  const classes = h("div.class-rows", { "data-testid": "class-rows" });
  const attributes = h("div.attribute-rows", { "data-testid": "attribute-rows" });
  const name = h("input", {
    "aria-label": "New class",
    placeholder: "New class",
    maxlength: 64,
    autocomplete: "off",
    "data-testid": "new-class",
    onkeydown: onEnter(add),
  });
  /** @type {Api.ClassList} */
  let listed;

  async function refresh() {
    listed = await app.api.get(path);
    const focused = document.activeElement?.getAttribute("aria-label");
    const names = listed.classes.map((row) => row.name);
    const rows = listed.classes.map((row, index) => classRow(row, index, names));
    patch(classes, rows);
    const others = schema().map((attribute) => attributeRow(attribute, names));
    patch(attributes, others.length ? others : h("p.muted", "None yet."));
    const again = focused ? classes.querySelector(`[aria-label="${CSS.escape(focused)}"]`) : null;
    if (again instanceof HTMLElement) again.focus();
  }

  const schema = () => /** @type {Attribute[]} */ (/** @type {unknown} */ (listed.attributes));

  async function change(/** @type {Parameters<ChangeClasses>[0]} */ body) {
    await app.api.post(path, body);
    showProblem(problem, null);
    await refresh();
    if (app.state.route.project === project) await app.refreshProject();
  }

  /** Makes a change of this dialog's own fields; a problem is shown, and the fields show what is stored. */
  async function put(/** @type {Parameters<ChangeClasses>[0]} */ body) {
    showProblem(problem, null);
    try {
      await change(body);
      return true;
    } catch (error) {
      showProblem(problem, error);
      await refresh();
      return false;
    }
  }

  async function add() {
    const label = name.value.trim();
    if (!label) name.focus();
    else if (await put({ do: "add", name: label })) name.value = "";
  }

  /** Adds what was typed but not added; a problem keeps the dialog open. */
  async function finish() {
    const label = name.value.trim();
    if (label) await change({ do: "add", name: label });
  }

  /** Buttons that move a row up and down. */
  function movers(
    /** @type {string} */ name,
    /** @type {string[]} */ all,
    /** @type {(names: string[]) => unknown} */ order,
  ) {
    const index = all.indexOf(name);
    const move = (/** @type {number} */ by) => () => order(all.toSpliced(index, 1).toSpliced(index + by, 0, name));
    return [
      iconButton("up", `Move ${name} up`, move(-1), { disabled: index === 0 }),
      iconButton("down", `Move ${name} down`, move(1), { disabled: index === all.length - 1 }),
    ];
  }

  function classRow(/** @type {Api.ClassRow} */ row, /** @type {number} */ index, /** @type {string[]} */ names) {
    const { name: label, colour, key } = row;
    const shown = classColor({ classes: names, class_styles: { [label]: colour ? { colour } : {} } }, label);
    const style = (/** @type {{ colour?: string | null, key?: string | null }} */ changes) =>
      put({ do: "style", name: label, style: changes });
    const picked = h("input", {
      type: "color",
      value: shown,
      title: "Colour",
      "aria-label": `Colour of ${label}`,
      onchange: (event) => style({ colour: fieldOf(event).value }),
    });
    const typed = h("input.key", {
      value: key ?? "",
      maxlength: 1,
      placeholder: "–",
      title: "Key, pressed with Alt: 0 to 9, a to z",
      "aria-label": `Key of ${label}`,
      onkeydown: onEnter((event) => fieldOf(event).blur()),
      onchange: (event) => style({ key: fieldOf(event).value.trim().toLowerCase() || null }),
    });
    const isOnly = { disabled: names.length < 2 };
    return h(
      "div.class-row",
      { "data-testid": "class-row", "data-name": label, "data-key": label },
      h("span.row", index < 9 ? h("kbd", String(index + 1)) : null),
      picked,
      colour ? iconButton("close", `Default colour for ${label}`, () => style({ colour: null })) : h("span"),
      h("strong.ellipsis", { title: label }, label),
      h("label.row.muted", "Alt", typed),
      h("span.muted.number", { "data-testid": "class-counts" }, boxesOf(row)),
      h(
        "span.row",
        movers(label, names, (order) => put({ do: "order", names: order })),
        button("Rename", () => askRename(row, change)),
        button("Merge", () => askMerge(row, names, change), isOnly),
        button("Remove", () => askRemove(row, change), isOnly),
      ),
    );
  }

  function attributeRow(/** @type {Attribute} */ attribute, /** @type {string[]} */ names) {
    const { name } = attribute;
    const all = schema().map((each) => each.name);
    const values = listed.values[name] ?? 0;
    return h(
      "div.attribute-row",
      { "data-testid": "attribute-row", "data-name": name, "data-key": name },
      h("span.grow", h("strong", name), ` ${describe(attribute)}`),
      h("span.muted.number", count(values, "value")),
      h(
        "span.row",
        movers(name, all, (order) => put({ do: "order_attributes", names: order })),
        button("Edit", () => attributeForm({ attribute, classes: names, attributes: schema(), change })),
        button("Rename", () => askRename({ ...attribute, values }, change)),
        button("Remove", () => askRemoveAttribute(attribute, values, change)),
      ),
    );
  }

  function addAttribute() {
    const names = listed.classes.map((row) => row.name);
    return attributeForm({ classes: names, attributes: schema(), change });
  }

  const stop = app.events.on("classes", refresh);
  try {
    await refresh();
    await openDialog({
      title: `Classes of ${project}`,
      testid: "classes-dialog",
      wide: true,
      content: [
        h("p.help", "Each change is saved at once, for everybody. Undo (Ctrl+Z) takes it back."),
        problem,
        classes,
        h("div.row", name, button("Add", add, { "data-testid": "add-class" })),
        h("h3", "Attributes"),
        h("p.help", "What is noted of each box, of each object along its track, or of each frame."),
        attributes,
        h("div.row", button("Add attribute", addAttribute, { "data-testid": "add-attribute" })),
      ],
      actions: [{ label: "Done", value: "done" }],
      submit: finish,
    });
  } finally {
    stop();
  }
}

const fieldOf = (/** @type {Event} */ { currentTarget }) => /** @type {HTMLInputElement} */ (currentTarget);
