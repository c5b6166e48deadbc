/** The dialog of a project's classes and attributes. Each change is saved at once, for everybody. */

import { projectPath } from "../api.js";
import { classColor } from "../colors.js";
import { openDialog } from "../dialogs.js";
import { button, count, h, iconButton, patch } from "../dom.js";
import { messageOf } from "../errors.js";
import { askMerge, askRemove, askRemoveAttribute, askRename, boxesOf } from "./asking.js";
import { attributeForm, describe } from "./attribute_form.js";

/** Shows the classes and attributes of a project until it is closed. */
export async function editClasses(/** @type {App} */ app, /** @type {string} */ project) {
  const path = projectPath(project, "classes");
  const problem = h("p.error-box", { role: "alert", hidden: true, "data-testid": "classes-problem" });
  const classes = h("div.class-rows", { "data-testid": "class-rows" });
  const attributes = h("div.attribute-rows", { "data-testid": "attribute-rows" });
  const name = h("input", {
    "aria-label": "New class",
    placeholder: "New class",
    maxlength: 64,
    autocomplete: "off",
    "data-testid": "new-class",
    onkeydown: onEnter(() => void add()),
  });
  /** @type {Api.ClassList} */
  let listed;

  async function refresh() {
    listed = await app.api.get(path);
    const focused = document.activeElement?.getAttribute("aria-label");
    const names = listed.classes.map((row) => row.name);
    patch(
      classes,
      listed.classes.map((row, index) => classRow(row, index, names)),
    );
    const rows = schema().map((attribute) => attributeRow(attribute, names));
    patch(attributes, rows.length ? rows : h("p.muted", "None yet."));
    const again = focused ? classes.querySelector(`[aria-label="${CSS.escape(focused)}"]`) : null;
    if (again instanceof HTMLElement) again.focus();
  }

  const schema = () => /** @type {Attribute[]} */ (/** @type {unknown} */ (listed.attributes));

  async function change(/** @type {Parameters<ChangeClasses>[0]} */ body) {
    await app.api.post(path, body);
    problem.hidden = true;
    await refresh();
    if (app.state.route.project === project) await app.refreshProject();
  }

  /** Makes a change of this dialog's own fields; a problem is shown, and the fields show what is stored. */
  async function put(/** @type {Parameters<ChangeClasses>[0]} */ body) {
    problem.hidden = true;
    try {
      await change(body);
      return true;
    } catch (error) {
      problem.textContent = messageOf(error);
      problem.hidden = false;
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

  function classRow(/** @type {Api.ClassRow} */ row, /** @type {number} */ index, /** @type {string[]} */ names) {
    const { name: label, colour, key } = row;
    const shown = classColor({ classes: names, class_styles: { [label]: colour ? { colour } : {} } }, label);
    const style = (/** @type {{ colour?: string | null, key?: string | null }} */ changes) =>
      put({ do: "style", name: label, style: changes });
    const move = (/** @type {number} */ to) =>
      put({ do: "order", names: names.toSpliced(index, 1).toSpliced(to, 0, label) });
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
        iconButton("up", `Move ${label} up`, () => move(index - 1), { disabled: index === 0 }),
        iconButton("down", `Move ${label} down`, () => move(index + 1), { disabled: index === names.length - 1 }),
        button("Rename", () => askRename(row, change)),
        button("Merge", () => askMerge(row, names, change), { disabled: names.length < 2 }),
        button("Remove", () => askRemove(row, change), { disabled: names.length < 2 }),
      ),
    );
  }

  function attributeRow(/** @type {Attribute} */ attribute, /** @type {string[]} */ names) {
    const all = schema().map((each) => each.name);
    const index = all.indexOf(attribute.name);
    const move = (/** @type {number} */ to) =>
      put({ do: "order_attributes", names: all.toSpliced(index, 1).toSpliced(to, 0, attribute.name) });
    const values = listed.values[attribute.name] ?? 0;
    return h(
      "div.attribute-row",
      { "data-testid": "attribute-row", "data-name": attribute.name, "data-key": attribute.name },
      h("span.grow", h("strong", attribute.name), ` ${describe(attribute)}`),
      h("span.muted.number", count(values, "value")),
      h(
        "span.row",
        iconButton("up", `Move ${attribute.name} up`, () => move(index - 1), { disabled: index === 0 }),
        iconButton("down", `Move ${attribute.name} down`, () => move(index + 1), {
          disabled: index === all.length - 1,
        }),
        button("Edit", () => attributeForm({ attribute, classes: names, attributes: schema(), change })),
        button("Rename", () => askRename({ ...attribute, values }, change)),
        button("Remove", () => askRemoveAttribute(attribute, values, change)),
      ),
    );
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
        h(
          "div.row",
          button(
            "Add attribute",
            () => attributeForm({ classes: listed.classes.map((row) => row.name), attributes: schema(), change }),
            { "data-testid": "add-attribute" },
          ),
        ),
      ],
      actions: [{ label: "Done", value: "done" }],
      submit: finish,
    });
  } finally {
    stop();
  }
}

const fieldOf = (/** @type {Event} */ { currentTarget }) => /** @type {HTMLInputElement} */ (currentTarget);

/**
 * Enter in a field would close the dialog.
 *
 * @returns {(event: KeyboardEvent) => void}
 */
function onEnter(/** @type {(event: KeyboardEvent) => void} */ fn) {
  return (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    event.stopPropagation();
    fn(event);
  };
}
