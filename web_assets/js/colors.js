/** A colour for each class; the colours are distinguishable on dark and light pictures and by colour-blind people. */

const PALETTE = ["#ff9f1c", "#2ec4f0", "#b5e61d", "#ff5d8f", "#9d8df1", "#ffe14d", "#3ddc97", "#ff7043", "#d0a2f7"];

/**
 * The colour of a class: the one that was set, else by its position in the project's list; grey if it is not listed.
 */
export function classColor(
  /** @type {Pick<Api.ProjectInfo, "classes" | "class_styles">} */ { classes, class_styles },
  /** @type {string} */ label,
) {
  const { colour } = /** @type {{ colour?: string }} */ (class_styles[label] ?? {});
  return colour ?? colorIn(classes, label);
}

/** The colour of a name by its position in a list. */
export function colorIn(/** @type {string[]} */ names, /** @type {string} */ name) {
  const index = names.indexOf(name);
  return index < 0 ? "#c3c9d4" : PALETTE[index % PALETTE.length];
}

/** The colour of a track by its id; consecutive ids get different colours. Grey for a box without a track. */
export function trackColor(/** @type {number | null} */ id) {
  return id === null ? "#c3c9d4" : PALETTE[Math.abs(id) % PALETTE.length];
}

/**
 * Whether white text is easier to read on a colour than black text.
 *
 * @param {string} color as #rrggbb
 */
export function isDark(color) {
  const [red, green, blue] = [1, 3, 5].map((at) => Number.parseInt(color.slice(at, at + 2), 16));
  return 0.299 * red + 0.587 * green + 0.114 * blue < 110;
}
