/** A colour for each class; the colours are distinguishable on dark and light pictures and by colour-blind people. */

const PALETTE = ["#ff9f1c", "#2ec4f0", "#b5e61d", "#ff5d8f", "#9d8df1", "#ffe14d", "#3ddc97", "#ff7043", "#d0a2f7"];

/**
 * The colour of a class by its position in the project's list; grey if it is not listed.
 *
 * @param {string[]} classes
 * @param {string} label
 */
export function classColor(classes, label) {
  const index = classes.indexOf(label);
  return index < 0 ? "#c3c9d4" : PALETTE[index % PALETTE.length];
}

/**
 * The colour of a track by its id; consecutive ids get different colours. Grey for a box without a track.
 *
 * @param {number | null} id
 */
export function trackColor(id) {
  return id === null ? "#c3c9d4" : PALETTE[Math.abs(id) % PALETTE.length];
}
