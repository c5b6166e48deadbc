/** How a 3D box is drawn on the image: its colour, its outline, its heading, and a text. */

import { valuesText } from "../attributes.js";
import { cameraOf, imageHeading, outline } from "../camera.js";
import { STATE_COLORS } from "../colors.js";
import { currentFrame } from "../frame_state.js";
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

/** A label on the camera image, as it is now; `color` replaces that of its state. @returns {Overlay} */
export function imageOverlay(
  /** @type {Annotate} */ { app, desk },
  /** @type {PageLabel} */ stored,
  /** @type {string | undefined} */ color,
) {
  const camera = cameraOf(currentFrame(app).image);
  const label = desk.seen(stored);
  const isSelected = label.uid === desk.uid;
  // the server has drawn the others as they are stored
  const isChanging = isSelected || label.isNew || desk.isDraft(label.uid);
  const name = shortName(label, desk.labels());
  const jump = jumpText(label);
  return {
    id: label.uid,
    segments: isChanging ? outline(camera, label.box) : label.outline,
    heading: imageHeading(camera, label.box),
    color: color ?? STATE_COLORS[label.state],
    dash: label.state === "rejected",
    strong: isSelected,
    tag: [isSelected ? selectedTag(label, name, valuesText(app, label)) : name, jump].filter(Boolean).join(" · "),
    wrong: jump !== "",
  };
}
