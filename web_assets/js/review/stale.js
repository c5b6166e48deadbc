/** A change that came too late: somebody else has changed the frame first. The operator says which version stays. */

import { outline } from "../camera.js";
import { askVersion } from "../stale.js";

const VERBS = { accept: "accepted", reject: "rejected", delete: "deleted", edit: "edited", track: "in another track", create: "added", finalise: "the frame is finalised", reopen: "the frame is opened again" };

/**
 * @param {ApiError} error with `body.state`, the frame as it is now.
 * @param {{changes: object[], subject: string | null, take: (frame: object) => void}} mine what was sent, and what takes a
 *     new state of the frame.
 * @throws {Error} mine could not be saved on top of theirs.
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
    if (!again.isStale) {
      take(theirs);
      throw again;
    }
    await resolveStale(app, again, { changes, subject, take });
  }
}

async function sendAgain(app, theirs, changes, subject) {
  const uids = new Set(theirs.labels.map(({ uid }) => uid));
  const present = changes.map((change) => (change.kind === "edit" && !uids.has(change.uid) ? asNew(change) : change));
  const fitting = present.filter(({ uid }) => uid === undefined || uids.has(uid));
  if (fitting.length === 0) throw new Error("The box is not there any more: somebody else has deleted it.");
  const body = { revision: theirs.frame.revision, changes: fitting, subject: uids.has(subject) ? subject : null };
  return app.api.change(app.path("frames", theirs.frame.id, "changes"), body);
}

/** An edited box that somebody else has deleted meanwhile comes back as a new one. */
const asNew = ({ label, box, track_id }) => ({ kind: "create", label, box, track_id });

function shown(theirs, changes) {
  const labels = new Map(theirs.labels.map((label) => [label.uid, label]));
  const { width, height } = theirs.image;
  const camera = { ...theirs.image.camera, width, height };
  const boxes = changes.map((change) => change.box ?? labels.get(change.uid)?.box).filter(Boolean);
  const text = changes.map(({ kind, uid, label }) => [label ?? labels.get(uid)?.label, VERBS[kind] ?? kind].filter(Boolean).join(": "));
  return { text, boxes: [], outlines: boxes.map((box) => outline(camera, box).flatMap(pairs)) };
}

const pairs = (line) => line.slice(1).map((end, i) => [line[i], end]);
