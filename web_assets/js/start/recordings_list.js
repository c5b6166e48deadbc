/** The dialog with the recordings of a project: removing one, and bringing back one that was removed. */

import { projectPath } from "../api.js";
import { confirm, openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { locateRecording } from "./recordings.js";

/**
 * Shows the recordings until the dialog is closed.
 *
 * @param {App} app
 * @param {string} project
 */
export async function manageRecordings(app, project) {
  const list = h("ul", { class: "recordings", role: "status" });
  const path = (/** @type {(string | number)[]} */ ...parts) => projectPath(project, "recordings", ...parts);

  /** @param {Promise<Api.ListedRecordings>} answer */
  async function show(answer) {
    try {
      const { recordings } = await answer;
      list.replaceChildren(...recordings.map(row));
      if (!recordings.length) list.append(h("li", { class: "muted" }, "No recording yet"));
    } catch (error) {
      app.toast(error);
    }
  }

  /** @param {Api.ListedRecording} recording */
  function row(recording) {
    const { id, name, frames, labels, missing, removed_by } = recording;
    const isGone = removed_by !== null;
    const numbers = [...(isGone ? [] : [count(frames, "frame")]), count(labels, "label")].join(", ");
    const states = [...(isGone ? [`removed by ${removed_by}`] : []), ...(missing ? ["its folder was not found"] : [])];
    return h(
      "li",
      { class: "row", "data-testid": `recording-${name}` },
      h("span", { class: `grow ellipsis${isGone ? " muted" : ""}`, title: name }, name),
      h("span", { class: "muted number" }, numbers),
      h("span", { class: missing ? "bad" : "muted" }, states.join("; ")),
      missing && button("Locate …", "locate", () => locate(recording)),
      isGone && !missing && button("Bring back", "restore", () => show(app.api.post(path(id, "restore")))),
      !isGone && button("Remove …", "remove", () => remove(recording)),
    );
  }

  /** @param {Api.ListedRecording} recording */
  async function locate(recording) {
    if (await locateRecording(app, project, recording)) await show(app.api.get(path()));
  }

  /** @param {Api.ListedRecording} recording */
  async function remove({ id, name, labels }) {
    const text =
      `Its ${count(labels, "label")} stay in the project's history, and come back with it. Until then they are ` +
      "neither shown nor counted, exported or trained on. Its files stay where they are.";
    if (await confirm(`Remove ${name} from ${project}?`, text, "Remove", "danger")) {
      await show(app.api.del(path(id)));
    }
  }

  await show(app.api.get(path()));
  return openDialog({
    title: `Recordings of ${project}`,
    testid: "recordings-dialog",
    wide: true,
    content: [list],
    actions: [{ label: "Done", value: "done" }],
  });
}

/**
 * @param {string} label
 * @param {string} id
 * @param {() => unknown} onclick
 */
function button(label, id, onclick) {
  return h("button", { type: "button", "data-testid": id, onclick }, label);
}
