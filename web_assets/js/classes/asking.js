/** The questions before a class or an attribute is renamed, merged or removed: they say what happens to the boxes. */

import { CANCEL, openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { field, select } from "../forms.js";

const UNDO = "Undo (Ctrl+Z) takes it back.";

/** The boxes of a class in words. */
export function boxesOf(/** @type {Api.ClassRow} */ { labels, boxes_2d, said }) {
  const known = [
    labels && count(labels, "3D label"),
    boxes_2d && count(boxes_2d, "2D box"),
    said && count(said, "further 3D box of a source", "further 3D boxes of sources"),
  ];
  return known.filter(Boolean).join(" and ") || "no boxes";
}

/**
 * @param {string} title
 * @param {Child[]} content
 * @param {{ label: string, kind?: string }} action
 * @param {() => unknown} done
 */
function ask(title, content, action, done) {
  const actions = [CANCEL, { ...action, value: "apply" }];
  return openDialog({ title, content, testid: "ask-classes", actions, submit: done });
}

/** Renames a class, an attribute, or one of its choices. */
export function askRename(
  /** @type {Api.ClassRow | (Attribute & { values: number })} */ what,
  /** @type {ChangeClasses} */ change,
) {
  const isClass = "labels" in what;
  const { name } = what;
  const choices = isClass ? [] : (what.choices ?? []);
  const input = h("input", { value: name, maxlength: 64, autofocus: true, "data-testid": "ask-name" });
  /** @type {HTMLSelectElement} */
  const part = select([["", "the attribute"], ...choices.map((each) => [each, `the choice ${each}`])], {
    "data-testid": "ask-part",
    onchange: () => Object.assign(input, { value: part.value || name }),
  });
  const follows = isClass ? `${boxesOf(what)}, and what detectors find` : count(what.values, "value");
  const content = [
    choices.length > 0 && field("What", part),
    field("New name", input),
    h("p.help", `Follows: ${follows}. ${UNDO}`),
    choices.length > 0 && h("p.help", "The name of another choice merges both."),
  ];
  return ask(`Rename ${name}`, content, { label: "Rename" }, () => {
    const fresh = input.value.trim();
    if (!fresh) throw new Error("Please give it a name.");
    if (isClass) return change({ do: "rename", name, new: fresh });
    return change({ do: "rename_attribute", name, new: fresh, choice: part.value || null });
  });
}

export function askMerge(
  /** @type {Api.ClassRow} */ row,
  /** @type {string[]} */ names,
  /** @type {ChangeClasses} */ change,
) {
  const others = names.filter((name) => name !== row.name).map((name) => [name]);
  const into = select(others, { "data-testid": "ask-into" });
  const content = [
    field("Give its boxes to", into),
    h("p", `The other class gets ${boxesOf(row)}, and ${row.name} is removed.`),
    h("p.help", UNDO),
  ];
  return ask(`Merge ${row.name}`, content, { label: "Merge" }, () =>
    change({ do: "merge", names: [row.name], into: into.value }),
  );
}

/** Removes a class; one with boxes only with these. */
export function askRemove(/** @type {Api.ClassRow} */ row, /** @type {ChangeClasses} */ change) {
  const { name } = row;
  const isUsed = row.labels + row.boxes_2d + row.said > 0;
  const text = isUsed
    ? `Deletes ${boxesOf(row)}, too. "Merge" gives them to another class instead.`
    : "No box is of this class.";
  const label = isUsed ? `Remove it with ${boxesOf(row)}` : "Remove";
  return ask(`Remove ${name}`, [h("p", text), h("p.help", UNDO)], { label, kind: "danger" }, () =>
    change({ do: "remove", name, with_boxes: isUsed }),
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
  return ask(`Remove ${name}`, [h("p", text), h("p.help", UNDO)], { label: "Remove", kind: "danger" }, () =>
    change({ do: "remove_attribute", name }),
  );
}
