/** What is drawn for a 3D box: its colour, its wire frame on the image, and its heading in a view. */

import { headingLine, toView } from "../box3d.js";
import { line, outline } from "../camera.js";

/** Bright on dark and light pictures alike; the viewport has the same. */
export const STATE_COLORS = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5", rejected: "#9aa1ad" };

/** What a label is called where there is little room: its track, or the beginning of its uid. */
export function shortName(label) {
  const id = label.track_id !== null ? `#${label.track_id}` : label.is_new ? "new" : label.uid.slice(0, 4);
  return `${label.label} ${id}`;
}

/** Lines of a label on the camera image; `box` is given where it is not the stored one, `color` where not the state's. */
export function imageOverlays(camera, label, { selected, box, color = STATE_COLORS[label.state] }) {
  const segments = box ? outline(camera, box) : label.outline;
  const tag = selected && !label.is_new ? `${shortName(label)} · ${label.state}` : shortName(label);
  const body = { id: label.uid, segments, color, dash: label.state === "rejected", strong: selected, tag };
  if (!selected) return [body];
  // no id: it is no target of its own
  return [body, { segments: line(camera, ...headingLine(box ?? label.box)), color, strong: true }];
}

/** An arrow from the middle of the box along its heading, in the px of a view; nothing where the view looks along it. */
export function viewHeading(view, box, color) {
  const [from, to] = headingLine(box).map((point) => toView(view, point));
  const along = [to[0] - from[0], to[1] - from[1]];
  const reach = Math.hypot(...along);
  if (reach < 3) return [];
  const [x, y] = along.map((value) => value / reach);
  const barb = Math.min(reach / 3, 9);
  const tip = (side) => [to[0] - barb * x - side * barb * 0.6 * y, to[1] - barb * y + side * barb * 0.6 * x];
  return [{ segments: [[from, to], [tip(1), to, tip(-1)]], color, strong: true, width: 1.6 }];
}
