/** How a 3D box is drawn: its colour, its outline on the image, and its heading in a view. */

import { headingLine, toView } from "../box3d.js";
import { line, outline } from "../camera.js";

/**
 * Colours by state: visible on dark and light pictures, and the same as in the 3D view.
 *
 * @type {Record<Api.ReviewState, string>}
 */
export const STATE_COLORS = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5", rejected: "#9aa1ad" };

/** Characters of the values at a box on the image. */
const MOST_VALUES = 40;

/**
 * A short name for a label: its class with its track id, or with the beginning of its uid.
 *
 * @param {PageLabel} label
 */
export function shortName(label) {
  const id = label.track_id !== null ? `#${label.track_id}` : label.isNew ? "new" : label.uid.slice(0, 4);
  return `${label.label} ${id}`;
}

/**
 * What is written at the selected box: also its state, and the values of its attributes as far as they are short.
 *
 * @param {PageLabel} label
 * @param {string} values
 */
function selectedTag(label, values) {
  const shown = values.length > MOST_VALUES ? `${values.slice(0, MOST_VALUES - 1)}…` : values;
  return [shortName(label), label.isNew ? "" : label.state, shown].filter(Boolean).join(" · ");
}

/**
 * Lines of a label on the camera image. `box` replaces the stored box, `color` the colour of the state.
 *
 * @param {Camera} camera
 * @param {PageLabel} label
 * @param {{ selected: boolean, box: Box3D | null, color?: string, values?: string }} shown values: of its attributes.
 * @returns {Overlay[]}
 */
export function imageOverlays(camera, label, { selected, box, color = STATE_COLORS[label.state], values = "" }) {
  const segments = box ? outline(camera, box) : label.outline;
  const tag = selected ? selectedTag(label, values) : shortName(label);
  const body = { id: label.uid, segments, color, dash: label.state === "rejected", strong: selected, tag };
  if (!selected) return [body];
  const [middle, front] = headingLine(box ?? label.box);
  // it has no id, so that it cannot be clicked
  return [body, { segments: line(camera, middle, front), color, strong: true }];
}

/**
 * An arrow from the middle of the box along its heading, in px of a view; none if the view looks along the heading.
 *
 * @param {Plane} view
 * @param {Box3D} box
 * @param {string} color
 * @returns {Overlay[]}
 */
export function viewHeading(view, box, color) {
  const [from, to] = headingLine(box).map((point) => toView(view, point));
  const along = [to[0] - from[0], to[1] - from[1]];
  const reach = Math.hypot(...along);
  if (reach < 3) return [];
  const [x, y] = along.map((value) => value / reach);
  const barb = Math.min(reach / 3, 9);
  /** @param {number} side */
  const tip = (side) => [to[0] - barb * x - side * barb * 0.6 * y, to[1] - barb * y + side * barb * 0.6 * x];
  return [
    {
      segments: [
        [from, to],
        [tip(1), to, tip(-1)],
      ],
      color,
      strong: true,
      width: 1.6,
    },
  ];
}
