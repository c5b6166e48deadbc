/** The panel of the picture: which recording it shows, and how. */

import { h } from "../dom.js";
import { createPicture } from "./picture.js";

/**
 * @param {Api.ProjectInfo["recordings"]} recordings
 * @param {{ onRecording: () => unknown, onMissing: (url: string) => unknown }} options
 *     `onRecording`: another recording was chosen; `onMissing`: its image could not be loaded.
 */
export function createPicturePanel(recordings, { onRecording, onMissing }) {
  const host = h("div", { class: "picture" });
  const problem = h("p", { class: "error-box", role: "alert", hidden: true, "data-testid": "alignment-problem" });
  const chosen = h(
    "select",
    { "data-testid": "alignment-recording", onchange: onRecording },
    ...recordings.map(({ id, name }) => h("option", { value: String(id) }, name)),
  );
  const points = h("input", { type: "checkbox", checked: true, onchange: display, "data-testid": "show-points" });
  const level = h("input", { type: "checkbox", checked: true, onchange: display, "data-testid": "show-level" });
  const size = h("input", { type: "range", min: 1, max: 8, step: 0.5, value: "2", oninput: display });
  const picture = createPicture(host, onMissing);

  function display() {
    picture.setShow({ points: points.checked, level: level.checked, size: Number(size.value) });
  }

  const header = h(
    "header",
    {},
    h("h2", { class: "ellipsis" }, "Cloud over image"),
    chosen,
    h("span", { class: "grow" }),
    h("label", { class: "row" }, points, "points"),
    h("label", { class: "row", title: "Size of the points" }, size),
    h("label", { class: "row" }, level, "level"),
  );
  const help = "Near points are red, far ones blue. The wheel zooms; drag to move the picture.";
  return {
    root: h("section", { class: "panel" }, header, problem, host, h("footer", { class: "help" }, help)),
    host,
    chosen,
    set: picture.set,
    close: picture.close,
    /** @param {string | null} text null: no problem. */
    setProblem(text) {
      problem.textContent = text;
      problem.hidden = text === null;
    },
  };
}
