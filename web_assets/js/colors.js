/** One colour a class, told apart on dark and light pictures and with the common colour blindnesses. */

const PALETTE = ["#ff9f1c", "#2ec4f0", "#b5e61d", "#ff5d8f", "#9d8df1", "#ffe14d", "#3ddc97", "#ff7043", "#d0a2f7"];

/** The colour of a class by its place in the project's list; grey for one that is not in it. */
export function classColor(classes, label) {
  const index = classes.indexOf(label);
  return index < 0 ? "#c3c9d4" : PALETTE[index % PALETTE.length];
}

/** The colour of a track by its id; neighbours differ. Grey for a box without one. */
export function trackColor(track_id) {
  return track_id === null ? "#c3c9d4" : PALETTE[Math.abs(track_id) % PALETTE.length];
}
