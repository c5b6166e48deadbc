/** How a 3D box is drawn on the image: its colour, its outline, its heading, and a text. */

import { imageHeading, outline } from "../camera.js";
import { STATE_COLORS } from "../colors.js";
import { jumpText } from "../heading_mark.js";

/** Characters of the values at a box on the image. */
const MOST_VALUES = 40;

/**
 * A short name for a label: its class with its track id; without a track, the class alone, with a number if the frame
 * has several such labels.
 *
 * @param {PageLabel} label
 * @param {PageLabel[]} all of its frame, in the order of their list.
 */
export function shortName(label, all) {
  if (label.track_id !== null) return `${label.label} #${label.track_id}`;
  if (label.isNew) return `${label.label} new`;
  const alike = all.filter((one) => one.track_id === null && one.label === label.label && !one.isNew);
  const at = alike.findIndex(({ uid }) => uid === label.uid);
  return at < 0 || alike.length < 2 ? label.label : `${label.label} (${at + 1})`;
}

/** What is written at the selected box: also its state, and the values of its attributes as far as they are short. */
function selectedTag(/** @type {PageLabel} */ label, /** @type {string} */ name, /** @type {string} */ values) {
  const shown = values.length > MOST_VALUES ? `${values.slice(0, MOST_VALUES - 1)}…` : values;
  return [name, label.isNew ? "" : label.state, shown].filter(Boolean).join(" · ");
}

/**
 * A label on the camera image. `box` replaces the stored box, `color` the colour of the state.
 *
 * @param {Camera} camera
 * @param {PageLabel} label
 * @param {{ name: string, selected: boolean, box: Box3D | null, color?: string, values?: string }} shown values: of
 *     its attributes.
 * @returns {Overlay}
 */
export function imageOverlay(camera, label, { name, selected, box, color = STATE_COLORS[label.state], values = "" }) {
  const segments = box ? outline(camera, box) : label.outline;
  const seen = box ?? label.box;
  const jump = jumpText({ ...label, box: seen });
  const tag = [selected ? selectedTag(label, name, values) : name, jump].filter(Boolean).join(" · ");
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
