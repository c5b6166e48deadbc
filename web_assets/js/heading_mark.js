/** A small arrow that shows in a list which way a box faces. */

import { anglesDeg, headingJump } from "./box3d.js";
import { h, s } from "./dom.js";

/** What is wrong with a heading that jumps, in a few words; "" if it does not. */
export function jumpText(/** @type {Parameters<typeof headingJump>[0]} */ label) {
  const jump = headingJump(label);
  return jump === null ? "" : `turned by ${Math.round(jump)}°`;
}

/** Seen from above: up is away from the camera. Red if the heading jumps. */
export function headingMark(/** @type {Parameters<typeof headingJump>[0]} */ label, /** @type {Vector | null} */ up) {
  const { yaw } = anglesDeg(label.box, up);
  const jump = jumpText(label);
  const turn = `rotate(${Math.round(-yaw)} 8 8)`;
  const arrow = s("path", { d: "M8 14.5V2M3.5 6.5 8 2l4.5 4.5", transform: turn });
  return h(
    "span",
    {
      class: jump ? "heading-mark bad" : "heading-mark",
      title: jump ? `${jump} from the box beside it in its track` : "Where it faces, seen from above",
      "data-testid": jump ? "heading-jump" : "heading-mark",
    },
    s("svg.glyph", { viewBox: "0 0 16 16", "aria-hidden": "true" }, arrow),
  );
}
