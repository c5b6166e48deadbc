/** A small arrow that shows in a list which way a box faces. */

import { headingJump } from "./box3d.js";
import { h, s } from "./dom.js";
import { yawOf } from "./rotation.js";

/** What is wrong with a heading that jumps, in a few words; "" if it does not. */
export function jumpText(/** @type {Parameters<typeof headingJump>[0]} */ label) {
  const jump = headingJump(label);
  return jump === null ? "" : `turned by ${Math.round(jump)}°`;
}

/**
 * Seen from above: up is away from the camera. Red if the heading jumps.
 *
 * @param {Vector} heading
 * @param {Vector | null} up
 * @param {string} [jump] as of `jumpText`.
 */
export function headingMark(heading, up, jump = "") {
  const turn = `rotate(${Math.round((-yawOf(heading, up) * 180) / Math.PI)} 8 8)`;
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
