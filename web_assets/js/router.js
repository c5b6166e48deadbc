/** Where the page is: #/ · #/PROJECT/MODE · #/PROJECT/MODE/FRAME, with further settings behind a question mark. */

export const MODES = ["label", "review", "train", "export", "statistics", "checks"];

/** "#/hands/label/3?uid=ab" -> {project: "hands", mode: "label", frame: 3, query: URLSearchParams}. */
export function parseHash(hash) {
  const [path, search = ""] = hash.replace(/^#\/?/, "").split("?");
  const [project = "", mode = "", frame = ""] = path.split("/").map(decode);
  const query = new URLSearchParams(search);
  if (!project) return { project: null, mode: "start", frame: null, query };
  return { project, mode: MODES.includes(mode) ? mode : "label", frame: /^\d+$/.test(frame) ? Number(frame) : null, query };
}

function decode(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/** The address of a mode: makeHash("hands", "review", 3, {uid: "ab"}). */
export function makeHash(project, mode, frame = null, query = {}) {
  const parts = [project, mode, ...(frame === null ? [] : [frame])].map((part) => encodeURIComponent(part));
  const search = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== null && value !== undefined)).toString();
  return `#/${parts.join("/")}${search ? `?${search}` : ""}`;
}
