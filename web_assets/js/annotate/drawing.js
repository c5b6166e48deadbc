/** How a 3D box is drawn on the image: its colour, its outline, its heading, and a text. */

import { imageHeading, outline } from "../camera.js";
import { STATE_COLORS } from "../colors.js";
import { jumpText } from "../heading_mark.js";

/** Characters of the values at a box on the image. */
const MOST_VALUES = 40;

/** A short name for a label: its class with its track id, or with the beginning of its uid. */
export function shortName(/** @type {PageLabel} */ label) {
  const id = label.track_id !== null ? `#${label.track_id}` : label.isNew ? "new" : label.uid.slice(0, 4);
  return `${label.label} ${id}`;
}

/** What is written at the selected box: also its state, and the values of its attributes as far as they are short. */
function selectedTag(/** @type {PageLabel} */ label, /** @type {string} */ values) {
  const shown = values.length > MOST_VALUES ? `${values.slice(0, MOST_VALUES - 1)}…` : values;
  return [shortName(label), label.isNew ? "" : label.state, shown].filter(Boolean).join(" · ");
}

/**
 * A label on the camera image. `box` replaces the stored box, `color` the colour of the state.
 *
 * @param {Camera} camera
 * @param {PageLabel} label
 * @param {{ selected: boolean, box: Box3D | null, color?: string, values?: string }} shown values: of its attributes.
 * @returns {Overlay}
 */
export function imageOverlay(camera, label, { selected, box, color = STATE_COLORS[label.state], values = "" }) {
  const segments = box ? outline(camera, box) : label.outline;
  const seen = box ?? label.box;
  const jump = jumpText({ ...label, box: seen });
  const tag = [selected ? selectedTag(label, values) : shortName(label), jump].filter(Boolean).join(" · ");
  const heading = imageHeading(camera, seen);
  return {
    id: label.uid,
    segments,
    heading,
    color,
    dash: label.state === "rejected",
    strong: selected,
    tag,
    wrong: jump !== "",
  };
}
