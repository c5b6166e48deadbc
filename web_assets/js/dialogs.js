/** Modal dialogs: a form in a <dialog>, which keeps the focus inside and closes with Escape. */

import { h, iconButton } from "./dom.js";
import { errorBox, showProblem } from "./forms.js";

/** Closes a dialog without doing anything. */
export const CANCEL = { label: "Cancel", value: "cancel" };

/**
 * Shows a dialog until one of its actions is done.
 *
 * @template [T=string]
 * @param {object} options
 * @param {string} options.title
 * @param {Child[]} options.content
 * @param {{label: string, value: string, kind?: string}[]} options.actions Enter triggers the last one.
 * @param {(value: string, form: HTMLFormElement) => T | Promise<T>} [options.submit] performs an action other than
 *     CANCEL; its result is the dialog's. If it throws, the dialog stays open and shows the error.
 * @param {boolean} [options.required] it cannot be closed without an action.
 * @param {boolean} [options.wide]
 * @param {string | null} [options.testid]
 * @returns {Promise<T | null>} null if it was closed without an action.
 */
export function openDialog({ title, content, actions, submit, required = false, wide = false, testid = null }) {
  return new Promise((resolve) => {
    const problem = errorBox();
    const buttons = actions.map(({ label, value, kind }, index) => {
      const look = kind ?? (index === actions.length - 1 ? "primary" : "");
      // fields need not be filled for "Cancel"
      const formnovalidate = index < actions.length - 1;
      const attributes = { type: "submit", value, class: look, formnovalidate, "data-testid": `dialog-${value}` };
      return h("button", attributes, label);
    });
    const last = buttons[buttons.length - 1];
    const dialog = h("dialog", { class: wide ? "wide" : "", "aria-label": title, "data-testid": testid });
    const close = required ? null : iconButton("close", "Close", () => dialog.close());
    const form = h(
      "form",
      { method: "dialog" },
      h("header", { role: "none" }, h("h2", title), close),
      // so that a table without fields can be scrolled by keys
      h("div.content", { tabindex: wide ? 0 : null }, content, problem),
      h("footer", { role: "none" }, buttons),
    );
    dialog.append(form);
    /** @type {T | null} */
    let result = null;
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const { value } = buttons.find((button) => button === event.submitter) ?? last;
      if (value === CANCEL.value) return dialog.close();
      for (const button of buttons) button.disabled = true;
      showProblem(problem, null);
      try {
        result = submit ? await submit(value, form) : /** @type {T} */ (value);
        dialog.close();
      } catch (error) {
        showProblem(problem, error);
      } finally {
        for (const button of buttons) button.disabled = false;
      }
    });
    // the browser would trigger the first action
    form.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && event.target instanceof HTMLInputElement) {
        event.preventDefault();
        form.requestSubmit(last);
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
    const first = form.querySelector("[autofocus]");
    (first instanceof HTMLElement ? first : last).focus();
  });
}

/** A question with two answers; true if it is confirmed. */
export async function confirm(
  /** @type {string} */ title,
  /** @type {string} */ text,
  /** @type {string} */ action,
  /** @type {string} */ kind = "primary",
) {
  const actions = [CANCEL, { label: action, value: "yes", kind }];
  return (await openDialog({ title, content: [h("p", text)], actions })) === "yes";
}

/**
 * Asks about something that is not saved: the operator can stay, save it, or discard it.
 *
 * @param {Unsaved} unsaved
 * @param {() => Unsaved | null} look returns what is still unsaved.
 * @returns {Promise<boolean>} true if nothing is unsaved any more.
 */
export async function askUnsaved(unsaved, look) {
  const choice = await openDialog({
    title: "Not everything is saved",
    testid: "unsaved-dialog",
    content: [h("p", unsaved.text)],
    actions: [
      { label: "Discard and continue", value: "discard", kind: "danger" },
      { label: "Stay here", value: "stay", kind: "" },
      { label: unsaved.action ?? "Try again", value: "retry" },
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
export function keyTableDialog(/** @type {Keys} */ keys) {
  /** @type {Map<string, KeyRow[]>} */
  const groups = new Map();
  for (const row of keys.table) groups.set(row.group, [...(groups.get(row.group) ?? []), row]);
  const sections = [...groups].map(([group, rows]) =>
    h("section", [
      h("h3", group),
      h(
        "dl",
        rows.flatMap((row) => [h("dt", keyCaps(row)), h("dd", row.label)]),
      ),
    ]),
  );
  return openDialog({
    title: "Keys",
    content: [h("div.key-table", sections)],
    actions: [{ label: "Close", value: "close" }],
    wide: true,
    testid: "key-table",
  });
}

function keyCaps(/** @type {KeyRow} */ row) {
  const names = row.shown ?? row.keys;
  return names.flatMap((name, index) => [
    index > 0 && !row.shown ? " or " : " ",
    ...name.split(/(?<=.)\+/).map((part) => h("kbd", part)),
  ]);
}
