/** Two versions of a frame: what somebody else has saved, and what was to be saved here. The operator decides; nothing is lost. */

import { openDialog } from "./dialogs.js";
import { count, h, s } from "./dom.js";

const STATE_COLOR = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5", rejected: "#7c8494" };
const MINE = "#ff5d8f";

/**
 * Shows both versions until one is chosen.
 *
 * @param {object} theirs FrameState: what the server has now.
 * @param {object} mine {text: [lines], boxes: [Box2D], outlines: [segments]}: what was to be saved, drawn over theirs.
 * @returns {Promise<"theirs"|"mine">} mine: put on top of theirs.
 */
export function askVersion({ theirs, mine }) {
  const authors = [...new Set(theirs.labels.map(({ author }) => author))].filter(Boolean);
  const counts = `${count(theirs.image_boxes?.boxes.length ?? 0, "box", "boxes")} on the image, ${count(theirs.labels.length, "box", "boxes")} in 3D${authors.length ? ` (by ${authors.join(", ")})` : ""}`;
  return openDialog({
    title: "Somebody changed this frame first",
    testid: "stale-dialog",
    wide: true,
    required: true,
    content: [
      h("p", {}, "Your last change was made on an older version and is not saved yet. Both versions are here; choose how to go on."),
      h(
        "div",
        { class: "versions" },
        h("figure", {}, h("figcaption", {}, h("strong", {}, "Saved now")), picture(theirs, null), h("p", { class: "help" }, counts)),
        h(
          "figure",
          {},
          h("figcaption", {}, h("strong", {}, "Yours, on top of it")),
          picture(theirs, mine),
          h("ul", { class: "help" }, mine.text.map((line) => h("li", {}, line))),
        ),
      ),
    ],
    actions: [
      { label: "Take theirs", value: "theirs", kind: "" },
      { label: "Put mine on top", value: "mine" },
    ],
  });
}

/** A frame's image with its boxes, small; `mine` is drawn over it where given. */
function picture(state, mine) {
  const { url, width, height } = state.image;
  const unit = width / 400;
  const svg = s(
    "svg",
    { class: "picture", viewBox: `-0.5 -0.5 ${width} ${height}`, role: "img", "aria-label": mine ? "Your version" : "The saved version" },
    s("image", { href: url, x: -0.5, y: -0.5, width, height }),
  );
  for (const box of state.image_boxes?.boxes ?? []) svg.append(rect(box, "#ffffff", unit));
  for (const label of state.labels) svg.append(lines(label.outline, STATE_COLOR[label.state], unit));
  for (const box of mine?.boxes ?? []) svg.append(rect(box, MINE, 2 * unit));
  for (const outline of mine?.outlines ?? []) svg.append(lines(outline, MINE, 2 * unit));
  return svg;
}

function rect(box, stroke, width) {
  return s("rect", { x: box.x_min, y: box.y_min, width: box.x_max - box.x_min, height: box.y_max - box.y_min, fill: "none", stroke, "stroke-width": width });
}

function lines(outline, stroke, width) {
  const d = (outline ?? []).map(([a, b]) => `M${a.join(" ")}L${b.join(" ")}`).join("");
  return s("path", { d, fill: "none", stroke, "stroke-width": width });
}
