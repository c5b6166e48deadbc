/**
 * Two versions of a frame: the saved version of others, and the operator's own. The operator chooses one.
 */

import { openDialog } from "./dialogs.js";
import { count, h, s } from "./dom.js";

const STATE_COLOR = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5", rejected: "#7c8494" };
const MINE = "#ff5d8f";

/**
 * Shows both versions until one is chosen.
 *
 * @param {{theirs: FrameState, mine: Mine}} versions the server's current state, and the state that was to be saved.
 * @returns {Promise<string | null>} "theirs", or "mine": to be applied to theirs and saved.
 */
export function askVersion({ theirs, mine }) {
  const authors = [...new Set(theirs.labels.map(({ author }) => author))].filter(Boolean);
  const onImage = count(theirs.image_boxes?.boxes.length ?? 0, "box", "boxes");
  const in3D = count(theirs.labels.length, "box", "boxes");
  const by = authors.length ? ` (by ${authors.join(", ")})` : "";
  const counts = `${onImage} on the image, ${in3D} in 3D${by}`;
  return openDialog({
    title: "Another operator has changed this frame",
    testid: "stale-dialog",
    wide: true,
    required: true,
    content: [
      h("p", "Your last change was made on an older version and is not saved yet. Choose between the two versions."),
      h(
        "div.versions",
        h("figure", h("figcaption", h("strong", "Saved version")), picture(theirs, null), h("p.help", counts)),
        h(
          "figure",
          h("figcaption", h("strong", "Your version")),
          picture(theirs, mine),
          h(
            "ul.help",
            mine.text.map((line) => h("li", line)),
          ),
        ),
      ),
    ],
    actions: [
      { label: "Keep theirs", value: "theirs", kind: "" },
      { label: "Save mine", value: "mine" },
    ],
  });
}

/** A small image of a frame with its boxes; `mine`, if given, is drawn over it. */
function picture(/** @type {FrameState} */ state, /** @type {Mine | null} */ mine) {
  const { url, width, height } = state.image;
  const unit = width / 400;
  const svg = s(
    "svg.picture",
    {
      viewBox: `-0.5 -0.5 ${width} ${height}`,
      role: "img",
      "aria-label": mine ? "Your version" : "The saved version",
    },
    s("image", { href: url, x: -0.5, y: -0.5, width, height }),
  );
  for (const box of state.image_boxes?.boxes ?? []) svg.append(rect(box, "#ffffff", unit));
  for (const label of state.labels) svg.append(lines(label.outline, STATE_COLOR[label.state], unit));
  for (const box of mine?.boxes ?? []) svg.append(rect(box, MINE, 2 * unit));
  for (const outline of mine?.outlines ?? []) svg.append(lines(outline, MINE, 2 * unit));
  return svg;
}

function rect(/** @type {Rect} */ box, /** @type {string} */ stroke, /** @type {number} */ width) {
  return s("rect", {
    x: box.x_min,
    y: box.y_min,
    width: box.x_max - box.x_min,
    height: box.y_max - box.y_min,
    fill: "none",
    stroke,
    "stroke-width": width,
  });
}

function lines(/** @type {Line[]} */ outline, /** @type {string} */ stroke, /** @type {number} */ width) {
  const d = (outline ?? []).map(([a, b]) => `M${a.join(" ")}L${b.join(" ")}`).join("");
  return s("path", { d, fill: "none", stroke, "stroke-width": width });
}
