/**
 * Two versions of a frame: the saved version of others, and the operator's own. The operator chooses one.
 */

import { STATE_COLORS } from "./colors.js";
import { openDialog } from "./dialogs.js";
import { bullets, count, h, s } from "./dom.js";

const MINE = "#ff5d8f";

/**
 * Shows both versions until one is chosen.
 *
 * @param {{theirs: FrameState, mine: Mine, name?: string}} versions the server's current state, and the state that was
 *     to be saved; the name of the frame, if it is not the open one.
 * @returns {Promise<string | null>} "theirs", or "mine": to be applied to theirs and saved.
 */
export function askVersion({ theirs, mine, name }) {
  const authors = [...new Set(theirs.labels.map(({ author }) => author))].filter(Boolean);
  const onImage = count(theirs.image_boxes?.boxes.length ?? 0, "box");
  const in3D = count(theirs.labels.length, "box");
  const by = authors.length ? ` (by ${authors.join(", ")})` : "";
  const counts = `${onImage} on the image, ${in3D} in 3D${by}`;
  return openDialog({
    title: `${name === undefined ? "This frame" : `Frame ${name}`} was changed elsewhere`,
    testid: "stale-dialog",
    wide: true,
    required: true,
    content: [
      h("p", [
        "By another operator, or in another tab. Your last change was made on an older version and is not saved yet: choose.",
      ]),
      h("div.versions", [
        version("Saved version", picture(theirs, null), h("p.help", counts)),
        version("Your version", picture(theirs, mine), bullets(mine.text, { class: "help" })),
      ]),
    ],
    actions: [
      { label: "Keep theirs", value: "theirs", kind: "" },
      { label: "Save mine", value: "mine" },
    ],
  });
}

const version = (/** @type {string} */ title, /** @type {Node[]} */ ...content) =>
  h("figure", h("figcaption", h("strong", title)), content);

/** A small image of a frame with its boxes; `mine`, if given, is drawn over it. */
function picture(/** @type {FrameState} */ state, /** @type {Mine | null} */ mine) {
  const { url, width, height } = state.image;
  const pen = (/** @type {string} */ stroke, /** @type {number} */ thick) => ({
    fill: "none",
    stroke,
    "stroke-width": (thick * width) / 400,
  });
  const rect = (/** @type {Rect} */ { x_min: x, y_min: y, x_max, y_max }, /** @type {object} */ look) =>
    s("rect", { x, y, width: x_max - x, height: y_max - y, ...look });
  const lines = (/** @type {Line[]} */ outline, /** @type {object} */ look) =>
    s("path", { d: (outline ?? []).map(([a, b]) => `M${a.join(" ")}L${b.join(" ")}`).join(""), ...look });
  const label = mine ? "Your version" : "The saved version";
  return s("svg.picture", { viewBox: `-0.5 -0.5 ${width} ${height}`, role: "img", "aria-label": label }, [
    s("image", { href: url, x: -0.5, y: -0.5, width, height }),
    (state.image_boxes?.boxes ?? []).map((box) => rect(box, pen("#ffffff", 1))),
    state.labels.map((label) => lines(label.outline, pen(STATE_COLORS[label.state], 1))),
    (mine?.boxes ?? []).map((box) => rect(box, pen(MINE, 2))),
    (mine?.outlines ?? []).map((outline) => lines(outline, pen(MINE, 2))),
  ]);
}
