/** Modal dialogs: a form in a <dialog>, which traps the focus and closes with Escape by itself. */

import { h, iconButton } from "./dom.js";

/**
 * Shows a dialog until one of its actions is done.
 *
 * @param {string} options.title
 * @param {Node[]} options.content
 * @param {{label: string, value: string, kind?: string}[]} options.actions the last one is what Enter does.
 * @param {(value: string, form: HTMLFormElement) => any} [options.submit] what an action does, may be async; its result is
 *     the dialog's. An exception keeps the dialog open and is shown in it.
 * @param {boolean} [options.required] no closing without an action.
 * @returns {Promise<any>} null where it was closed.
 */
export function openDialog({ title, content, actions, submit = (value) => value, required = false, wide = false, testid = null }) {
  return new Promise((resolve) => {
    const problem = h("p", { class: "error-box", role: "alert", hidden: true });
    const buttons = actions.map(({ label, value, kind }, index) =>
      h("button", { type: "submit", value, class: kind ?? (index === actions.length - 1 ? "primary" : ""), "data-testid": `dialog-${value}` }, label),
    );
    const close = required ? null : iconButton("close", "Close", () => dialog.close());
    const form = h(
      "form",
      { method: "dialog" },
      h("header", {}, h("h2", {}, title), close),
      h("div", { class: "content" }, content, problem),
      h("footer", {}, buttons),
    );
    const dialog = h("dialog", { class: wide ? "wide" : "", "aria-label": title, "data-testid": testid }, form);
    let result = null;
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const value = (event.submitter ?? buttons.at(-1)).value;
      for (const button of buttons) button.disabled = true;
      problem.hidden = true;
      try {
        result = await submit(value, form);
        dialog.close();
      } catch (error) {
        problem.textContent = error.message;
        problem.hidden = false;
      } finally {
        for (const button of buttons) button.disabled = false;
      }
    });
    // Enter in a field does the last action, which is the first one of a row of buttons for the browser.
    form.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && event.target.tagName === "INPUT") {
        event.preventDefault();
        form.requestSubmit(buttons.at(-1));
      }
    });
    dialog.addEventListener("cancel", (event) => {
      if (required) event.preventDefault();
    });
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(result);
    });
    document.body.append(dialog);
    dialog.showModal();
    (form.querySelector("[autofocus]") ?? buttons.at(-1)).focus();
  });
}

/** A question with two answers; true where it is confirmed. */
export async function confirm(title, text, action, kind = "primary") {
  const actions = [{ label: "Cancel", value: "no" }, { label: action, value: "yes", kind }];
  return (await openDialog({ title, content: [h("p", {}, text)], actions })) === "yes";
}

/**
 * What cannot be saved: the operator stays with it, tries again, or gives it up.
 *
 * @param {{text: string, retry: () => any, discard: () => void}} unsaved
 * @param {() => object | null} look what is unsaved by now.
 * @returns {Promise<boolean>} true where nothing is left that could be lost.
 */
export async function askUnsaved(unsaved, look) {
  const choice = await openDialog({
    title: "Not everything is saved",
    testid: "unsaved-dialog",
    content: [h("p", {}, unsaved.text)],
    actions: [
      { label: "Discard and go on", value: "discard", kind: "danger" },
      { label: "Stay here", value: "stay", kind: "" },
      { label: "Try again", value: "retry" },
    ],
    async submit(value) {
      if (value === "discard") unsaved.discard();
      if (value === "retry") await unsaved.retry();
      const left = value === "retry" ? look() : null;
      if (left) throw new Error(left.text);
      return value;
    },
  });
  return choice === "discard" || choice === "retry";
}

/** The key table. */
export function keyTableDialog(keys) {
  const groups = new Map();
  for (const row of keys.table) groups.set(row.group, [...(groups.get(row.group) ?? []), row]);
  const sections = [...groups].map(([group, rows]) =>
    h(
      "section",
      {},
      h("h3", {}, group),
      h("dl", {}, rows.flatMap((row) => [h("dt", {}, keyCaps(row)), h("dd", {}, row.label)])),
    ),
  );
  return openDialog({
    title: "Keys",
    content: [h("div", { class: "key-table" }, sections)],
    actions: [{ label: "Close", value: "close" }],
    wide: true,
    testid: "key-table",
  });
}

function keyCaps(row) {
  const names = row.shown ?? row.keys;
  return names.flatMap((name, index) => [index > 0 && !row.shown ? " or " : " ", ...name.split(/(?<=.)\+/).map((part) => h("kbd", {}, part))]);
}
