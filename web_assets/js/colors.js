/** The colours of boxes: by state, class or track. */

/**
 * Colours by state: visible on dark and light pictures, and the same as in the 3D view. What is proposed, dashed or not,
 * has a colour that no class has.
 *
 * @type {Record<Api.ReviewState, string>}
 */
export const STATE_COLORS = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5", rejected: "#9aa1ad" };

export const STATES = Object.keys(STATE_COLORS);

/** Of 20 classes; any two, and each beside what is proposed, are at least 0.12 apart in OKLab. */
export const PALETTE = [
  ...["#2ec4f0", "#ff5d8f", "#b5e61d", "#9d8df1", "#fc6c0c", "#3ddc97", "#b40cc0", "#0c60fc", "#f0e49c", "#488400"],
  ...["#fcc0fc", "#24849c", "#78fcfc", "#d80054", "#90a83c", "#8430fc", "#b4540c", "#f09ca8", "#9c6090", "#fc48fc"],
];

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

/**
 * Calls a function when the page gets other colours: by its switch, or because the system has turned dark or light.
 *
 * @returns {() => void} ends that.
 */
export function onTheme(/** @type {() => void} */ fn) {
  const watcher = new MutationObserver(fn);
  watcher.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", fn);
  return () => {
    watcher.disconnect();
    scheme.removeEventListener("change", fn);
  };
}

/**
 * The theme that is shown.
 *
 * @returns {Api.Theme}
 */
export function themeNow() {
  const { theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light" } =
    document.documentElement.dataset;
  return theme === "light" ? "light" : "dark";
}
