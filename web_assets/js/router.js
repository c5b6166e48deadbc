/** The page's addresses: #/ · #/PROJECT/MODE · #/PROJECT/MODE/FRAME, each with an optional ?query. */

const MODES = ["label", "review", "train", "export", "statistics", "checks", "alignment"];

/**
 * "#/hands/label/3?uid=ab" -> {project: "hands", mode: "label", frame: 3, query: URLSearchParams}.
 *
 * @param {string} hash
 * @returns {Route}
 */
export function parseHash(hash) {
  const [path, search = ""] = hash.replace(/^#\/?/, "").split("?");
  const [project = "", mode = "", frame = ""] = path.split("/").map(decode);
  const query = new URLSearchParams(search);
  if (!project) return { project: null, mode: "start", frame: null, query };
  return {
    project,
    mode: MODES.includes(mode) ? mode : "label",
    frame: /^\d+$/.test(frame) ? Number(frame) : null,
    query,
  };
}

/** @param {string} part */
function decode(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/**
 * The address of a mode: makeHash("hands", "review", 3, {uid: "ab"}).
 *
 * @param {string} project
 * @param {string} mode
 * @param {number | null} [frame]
 * @param {Record<string, string | null | undefined>} [query]
 */
export function makeHash(project, mode, frame = null, query = {}) {
  const parts = [project, mode, ...(frame === null ? [] : [frame])].map((part) => encodeURIComponent(part));
  const search = new URLSearchParams(Object.entries(query).flatMap(([name, value]) => (value ? [[name, value]] : [])));
  return `#/${parts.join("/")}${search.size ? `?${search}` : ""}`;
}
