/** If others have changed the frame in the meantime, the operator chooses between the two versions. */

import { cameraOf, outline } from "../camera.js";
import { isStale } from "../errors.js";
import { askVersion } from "../stale.js";

/** @type {Record<string, string>} */
const VERBS = {
  accept: "accepted",
  reject: "rejected",
  delete: "deleted",
  edit: "edited",
  track: "moved to another track",
  create: "added",
  finalise: "frame finalised",
  reopen: "frame reopened",
};

/**
 * @param {Pick<App, "api" | "path">} app
 * @param {StaleError} error
 * @param {{changes: Change[], subject: string | null, take: (frame: FrameState) => unknown}} sent what
 *     was sent; `take` is called with a new state of the frame.
 * @throws {Error} the operator's version could not be applied to the others' version.
 */
export async function resolveStale(app, error, { changes, subject, take }) {
  const theirs = error.body.state;
  const choice = await askVersion({ theirs, mine: shown(theirs, changes) });
  if (choice === "theirs") {
    take(theirs);
    return;
  }
  try {
    take(await sendAgain(app, theirs, changes, subject));
  } catch (again) {
    if (!isStale(again)) {
      take(theirs);
      throw again;
    }
    await resolveStale(app, again, { changes, subject, take });
  }
}

/**
 * @param {Pick<App, "api" | "path">} app
 * @param {FrameState} theirs
 * @param {Change[]} changes
 * @param {string | null} subject
 * @returns {Promise<FrameState>}
 */
async function sendAgain(app, theirs, changes, subject) {
  const uids = new Set(theirs.labels.map(({ uid }) => uid));
  const isGone = (/** @type {Change} */ { uid }) => uid !== undefined && !uids.has(uid);
  const present = changes.map((change) => (change.kind === "edit" && isGone(change) ? asNew(change) : change));
  const fitting = present.filter((change) => !isGone(change));
  if (fitting.length === 0) throw new Error("Another operator has deleted the box.");
  const body = {
    revision: theirs.frame.revision,
    changes: fitting,
    subject: subject !== null && uids.has(subject) ? subject : null,
  };
  return app.api.change(app.path("frames", theirs.frame.id, "changes"), body);
}

/**
 * The change that adds an edited box again, as a new one, after others have deleted it.
 *
 * @param {Change} change
 * @returns {Change}
 */
const asNew = ({ label, box, track_id }) => ({ kind: "create", label, box, track_id });

/**
 * @param {FrameState} theirs
 * @param {Change[]} changes
 * @returns {Mine}
 */
function shown(theirs, changes) {
  const labels = new Map(theirs.labels.map((label) => [label.uid, label]));
  const camera = cameraOf(theirs.image);
  const boxes = changes.flatMap(({ box, uid }) => box ?? labels.get(uid ?? "")?.box ?? []);
  const text = changes.map(({ kind, uid, label }) =>
    [label ?? labels.get(uid ?? "")?.label, VERBS[kind] ?? kind].filter(Boolean).join(": "),
  );
  return { text, boxes: [], outlines: boxes.map((box) => outline(camera, box).flatMap(pairs)) };
}

/** @param {Line} line */
const pairs = (line) => line.slice(1).map((end, i) => [line[i], end]);
