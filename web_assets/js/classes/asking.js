/** The questions before a class or an attribute is renamed, merged or removed: they say what happens to the boxes. */

import { openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";

const UNDO = "Undo (Ctrl+Z) takes it back.";

/** The boxes of a class in words. */
export function boxesOf(/** @type {Api.ClassRow} */ { labels, boxes_2d, said }) {
  const known = [
    labels && count(labels, "3D label"),
    boxes_2d && count(boxes_2d, "2D box", "2D boxes"),
    said && count(said, "further 3D box of a source", "further 3D boxes of sources"),
  ];
  return known.filter(Boolean).join(" and ") || "no boxes";
}

/**
 * @param {object} question
 * @param {string} question.title
 * @param {Node[]} question.content
 * @param {string} question.action
 * @param {string} [question.kind]
 * @param {() => Promise<unknown>} done
 */
function ask({ title, content, action, kind }, done) {
  return openDialog({
    title,
    content,
    testid: "ask-classes",
    actions: [
      { label: "Cancel", value: "cancel" },
      { label: action, value: "apply", kind },
    ],
    async submit(value) {
      if (value === "apply") await done();
      return value;
    },
  });
}

function choice(/** @type {string} */ text, /** @type {string[]} */ names) {
  const select = h(
    "select",
    { "data-testid": "ask-into" },
    names.map((name) => h("option", { value: name }, name)),
  );
  return { select, root: h("label.field", h("span", text), select) };
}

/** Renames a class, an attribute, or one of its choices. */
export function askRename(
  /** @type {Api.ClassRow | (Attribute & { values: number })} */ what,
  /** @type {ChangeClasses} */ change,
) {
  const isClass = "labels" in what;
  const { name } = what;
  const choices = isClass ? [] : (what.choices ?? []);
  /** @type {HTMLSelectElement} */
  const part = h(
    "select",
    { "data-testid": "ask-part", onchange: () => Object.assign(input, { value: part.value || name }) },
    h("option", { value: "" }, "the attribute"),
    choices.map((each) => h("option", { value: each }, `the choice ${each}`)),
  );
  const input = h("input", { value: name, maxlength: 64, autofocus: true, "data-testid": "ask-name" });
  const follow = isClass
    ? `Follows: ${boxesOf(what)}, and what detectors find`
    : `Follows: ${count(what.values, "value")}`;
  return ask(
    {
      title: `Rename ${name}`,
      content: [
        choices.length ? h("label.field", h("span", "What"), part) : null,
        h("label.field", h("span", "New name"), input),
        h("p.help", `${follow}. ${UNDO}`),
        choices.length ? h("p.help", "The name of another choice merges both.") : null,
      ].filter((node) => node !== null),
      action: "Rename",
    },
    () => {
      const fresh = input.value.trim();
      if (!fresh) throw new Error("Please give it a name.");
      if (isClass) return change({ do: "rename", name, new: fresh });
      return change({ do: "rename_attribute", name, new: fresh, choice: part.value || null });
    },
  );
}

export function askMerge(
  /** @type {Api.ClassRow} */ row,
  /** @type {string[]} */ names,
  /** @type {ChangeClasses} */ change,
) {
  const into = choice(
    `Give its boxes to`,
    names.filter((name) => name !== row.name),
  );
  return ask(
    {
      title: `Merge ${row.name}`,
      content: [
        into.root,
        h("p", `The other class gets ${boxesOf(row)}, and ${row.name} is removed.`),
        h("p.help", UNDO),
      ],
      action: "Merge",
    },
    () => change({ do: "merge", names: [row.name], into: into.select.value }),
  );
}

/** Removes a class; one with boxes only with these. */
export function askRemove(/** @type {Api.ClassRow} */ row, /** @type {ChangeClasses} */ change) {
  const isUsed = row.labels + row.boxes_2d + row.said > 0;
  const text = isUsed
    ? `Deletes ${boxesOf(row)}, too. "Merge" gives them to another class instead.`
    : "No box is of this class.";
  return ask(
    {
      title: `Remove ${row.name}`,
      content: [h("p", text), h("p.help", UNDO)],
      action: isUsed ? `Remove it with ${boxesOf(row)}` : "Remove",
      kind: "danger",
    },
    () => change({ do: "remove", name: row.name, with_boxes: isUsed }),
  );
}

export function askRemoveAttribute(
  /** @type {Attribute} */ { name },
  /** @type {number} */ values,
  /** @type {ChangeClasses} */ change,
) {
  const text = values
    ? `${count(values, "value")} of it will be removed, too.`
    : "No box and no frame has a value of it.";
  return ask(
    {
      title: `Remove ${name}`,
      content: [h("p", text), h("p.help", UNDO)],
      action: "Remove",
      kind: "danger",
    },
    () => change({ do: "remove_attribute", name }),
  );
}
