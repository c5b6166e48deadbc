/** The page's addresses: #/ · #/PROJECT/MODE · #/PROJECT/MODE/FRAME, each with an optional ?query. */

/** In the order of their tabs. */
export const MODES = ["annotate", "train", "export", "statistics", "checks", "alignment"];

/**
 * "#/hands/annotate/3?uid=ab" -> {project: "hands", mode: "annotate", frame: 3, query: URLSearchParams}.
 *
 * @returns {Route}
 */
export function parseHash(/** @type {string} */ hash) {
  const [path, search = ""] = hash.replace(/^#\/?/, "").split("?");
  const [project = "", mode = "", frame = ""] = path.split("/").map(decode);
  const query = new URLSearchParams(search);
  if (!project) return { project: null, mode: "start", frame: null, query };
  return {
    project,
    // also for the addresses of the modes Label and Review, of which it is made
    mode: MODES.includes(mode) ? mode : "annotate",
    frame: /^\d+$/.test(frame) ? Number(frame) : null,
    query,
  };
}

function decode(/** @type {string} */ part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/** The address of a mode: makeHash("hands", "annotate", 3, {uid: "ab"}). */
export function makeHash(
  /** @type {string} */ project,
  /** @type {string} */ mode,
  /** @type {number | null} */ frame = null,
  /** @type {Record<string, string | null | undefined>} */ query = {},
) {
  const parts = [project, mode, ...(frame === null ? [] : [frame])].map((part) => encodeURIComponent(part));
  const search = new URLSearchParams(Object.entries(query).flatMap(([name, value]) => (value ? [[name, value]] : [])));
  return `#/${parts.join("/")}${search.size ? `?${search}` : ""}`;
}
