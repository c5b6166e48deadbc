/**
 * The position of a picture in its window: window = offset + (px + 0.5) * scale, in CSS pixels of the window.
 * 0.5 is added because the picture's left edge is at px -0.5.
 */

import { clamp } from "./geometry.js";

const MARGIN = 4;
const LARGEST_SCALE = 64;

export function createView() {
  const view = {
    scale: 1,
    offset: [0, 0],
    isFitted: true,

    /** @param {Point} point */
    toWindow: ([x, y]) => [view.offset[0] + (x + 0.5) * view.scale, view.offset[1] + (y + 0.5) * view.scale],
    /** @param {Point} point */
    toPicture: ([x, y]) => [(x - view.offset[0]) / view.scale - 0.5, (y - view.offset[1]) / view.scale - 0.5],

    /**
     * Shows the whole picture, centred in the window.
     *
     * @param {Size} picture
     * @param {Size} size
     */
    fit(picture, size) {
      if (!picture.width || !size.width || !size.height) return;
      view.scale = fitScale(picture, size);
      view.offset = [(size.width - picture.width * view.scale) / 2, (size.height - picture.height * view.scale) / 2];
      view.isFitted = true;
    },

    /**
     * Zooms by a factor about a point of the window, which keeps showing the same point of the picture.
     *
     * @param {Point} point
     * @param {number} factor
     * @param {Size} picture
     * @param {Size} size
     */
    zoomAbout([x, y], factor, picture, size) {
      const smallest = Math.min(fitScale(picture, size) / 3, 1);
      const scale = clamp(view.scale * factor, smallest, LARGEST_SCALE);
      const share = scale / view.scale;
      view.offset = [x - (x - view.offset[0]) * share, y - (y - view.offset[1]) * share];
      view.scale = scale;
      view.isFitted = false;
    },

    /**
     * Shifts the picture; a strip of it always stays in the window.
     *
     * @param {number} dx
     * @param {number} dy
     * @param {Size} picture
     * @param {Size} size
     */
    panBy(dx, dy, picture, size) {
      const keep = 32;
      view.offset = [
        clamp(view.offset[0] + dx, keep - picture.width * view.scale, size.width - keep),
        clamp(view.offset[1] + dy, keep - picture.height * view.scale, size.height - keep),
      ];
      view.isFitted = false;
    },
  };
  return view;
}

/**
 * @param {Size} picture
 * @param {Size} size
 */
function fitScale(picture, size) {
  return Math.min((size.width - 2 * MARGIN) / picture.width, (size.height - 2 * MARGIN) / picture.height);
}
