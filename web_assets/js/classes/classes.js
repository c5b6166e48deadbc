/** The dialog of a project's classes and attributes. Each change is saved at once, for everybody. */

import { projectPath } from "../api.js";
import { classColor } from "../colors.js";
import { CANCEL, confirm, openDialog } from "../dialogs.js";
import { button, count, h, iconButton, patch } from "../dom.js";
import { errorBox, field, onEnter, select, showProblem } from "../forms.js";
import { attributeForm } from "./attribute_form.js";

const UNDO = "Undo (Ctrl+Z) takes it back.";

/** @typedef {Parameters<ChangeClasses>[0]} Change */

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

  async function change(/** @type {Change} */ body) {
    await app.api.post(path, body);
    showProblem(problem, null);
    await refresh();
    if (app.state.route.project === project) await app.refreshProject();
  }

  /** Makes a change of this dialog's own fields; a problem is shown, and the fields show what is stored. */
  async function put(/** @type {Change} */ body) {
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
    return h("div.class-row", { "data-testid": "class-row", "data-name": label, "data-key": label }, [
      h("span.row", index < 9 ? h("kbd", String(index + 1)) : null),
      picked,
      colour ? iconButton("close", `Default colour for ${label}`, () => style({ colour: null })) : h("span"),
      h("strong.ellipsis", { title: label }, label),
      h("label.row.muted", "Alt", typed),
      h("span.muted.number", { "data-testid": "class-counts" }, row.boxes),
      h("span.row", [
        movers(label, names, (order) => put({ do: "order", names: order })),
        button("Rename", () => rename(row)),
        button("Merge", () => merge(row, names), isOnly),
        button("Remove", () => removeClass(row), isOnly),
      ]),
    ]);
  }

  function attributeRow(/** @type {Attribute} */ attribute, /** @type {string[]} */ names) {
    const { name } = attribute;
    const all = schema().map((each) => each.name);
    const values = listed.values[name] ?? 0;
    return h("div.attribute-row", { "data-testid": "attribute-row", "data-name": name, "data-key": name }, [
      h("span.grow", h("strong", name), ` ${listed.words[name]}`),
      h("span.muted.number", count(values, "value")),
      h("span.row", [
        movers(name, all, (order) => put({ do: "order_attributes", names: order })),
        button("Edit", () => attributeForm({ attribute, classes: names, attributes: schema(), change })),
        button("Rename", () => rename({ ...attribute, values })),
        button("Remove", () => removeAttribute(name, values)),
      ]),
    ]);
  }

  // -- the questions before a change, which say what happens to the boxes

  /** Asks what a change needs; one that is refused is said in the dialog. */
  const ask = (
    /** @type {string} */ title,
    /** @type {Child[]} */ content,
    /** @type {string} */ label,
    /** @type {() => Change} */ read,
  ) =>
    openDialog({
      title,
      content,
      testid: "ask-classes",
      actions: [CANCEL, { label, value: "apply" }],
      submit: () => change(read()),
    });

  /** Renames a class, an attribute, or one of its choices. */
  function rename(/** @type {Api.ClassRow | (Attribute & { values: number })} */ what) {
    const isClass = "labels" in what;
    const { name: old } = what;
    const choices = isClass ? [] : (what.choices ?? []);
    const input = h("input", { value: old, maxlength: 64, autofocus: true, "data-testid": "ask-name" });
    /** @type {HTMLSelectElement} */
    const part = select([["", "the attribute"], ...choices.map((each) => [each, `the choice ${each}`])], {
      "data-testid": "ask-part",
      onchange: () => Object.assign(input, { value: part.value || old }),
    });
    const follows = isClass ? `${what.boxes}, and what detectors find` : count(what.values, "value");
    const content = [
      choices.length > 0 && field("What", part),
      field("New name", input),
      h("p.help", `Follows: ${follows}. ${UNDO}`),
      choices.length > 0 && h("p.help", "The name of another choice merges both."),
    ];
    return ask(`Rename ${old}`, content, "Rename", () => {
      const fresh = input.value.trim();
      if (!fresh) throw new Error("Please give it a name.");
      if (isClass) return { do: "rename", name: old, new: fresh };
      return { do: "rename_attribute", name: old, new: fresh, choice: part.value || null };
    });
  }

  function merge(/** @type {Api.ClassRow} */ row, /** @type {string[]} */ names) {
    const others = names.filter((each) => each !== row.name).map((each) => [each]);
    const into = select(others, { "data-testid": "ask-into" });
    const content = [
      field("Give its boxes to", into),
      h("p", `The other class gets ${row.boxes}, and ${row.name} is removed.`),
      h("p.help", UNDO),
    ];
    return ask(`Merge ${row.name}`, content, "Merge", () => ({ do: "merge", names: [row.name], into: into.value }));
  }

  /** Removes a class; one with boxes only with these. */
  async function removeClass(/** @type {Api.ClassRow} */ row) {
    const isUsed = row.labels + row.boxes_2d + row.said > 0;
    const text = isUsed
      ? `Deletes ${row.boxes}, too. "Merge" gives them to another class instead.`
      : "No box is of this class.";
    const label = isUsed ? `Remove it with ${row.boxes}` : "Remove";
    if (await confirm(`Remove ${row.name}`, `${text} ${UNDO}`, label, "danger"))
      await put({ do: "remove", name: row.name, with_boxes: isUsed });
  }

  async function removeAttribute(/** @type {string} */ attribute, /** @type {number} */ values) {
    const text = values
      ? `${count(values, "value")} of it will be removed, too.`
      : "No box and no frame has a value of it.";
    if (await confirm(`Remove ${attribute}`, `${text} ${UNDO}`, "Remove", "danger"))
      await put({ do: "remove_attribute", name: attribute });
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
