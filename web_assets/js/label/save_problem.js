/** Why a change could not be saved, and what to do: try again, save it as another class, or discard. */

import { h } from "../dom.js";

/**
 * @param {ModeApp} app
 * @param {Saver} saver
 * @param {object} listeners
 * @param {(renamed: Record<string, string>) => void} listeners.onRelabel gives unsaved boxes another class.
 * @param {() => void} listeners.onDiscard drops what is not saved.
 */
export function createSaveProblem(app, saver, { onRelabel, onDiscard }) {
  const root = h("span", { class: "problem", role: "alert", "data-testid": "save-problem" });

  /** @param {string} gone */
  function choice(gone) {
    const options = app.state.project.classes.map((name) => h("option", {}, name));
    const select = h(
      "select",
      { "aria-label": `Class in place of ${gone}`, "data-testid": "save-as" },
      h("option", { value: "", disabled: true, selected: true }, "save it as …"),
      options,
    );
    select.addEventListener("change", () => onRelabel({ [gone]: select.value }));
    return select;
  }

  function show() {
    root.replaceChildren();
    if (!saver.problem) return;
    const gone = [...saver.labels()].find((label) => !app.state.project.classes.includes(label));
    root.append(
      `Not saved: ${saver.problem.message} `,
      gone === undefined ? h("button", { type: "button", onclick: () => saver.retry() }, "Try again") : choice(gone),
      " ",
      h("button", { type: "button", onclick: onDiscard }, "Discard"),
    );
  }

  return { root, show };
}
