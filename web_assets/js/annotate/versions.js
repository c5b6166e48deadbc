/** What an operator's changes are on a frame that others have changed, and which of two boxes of a track stays. */

import { cameraOf, outline } from "../camera.js";
import { openDialog } from "../dialogs.js";
import { h } from "../dom.js";

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
 * The body of changes of a frame: of those whose boxes are there, and edited boxes that others have deleted are added.
 *
 * @throws {Error} there is none of them.
 */
export function changesOn(
  /** @type {FrameState} */ state,
  /** @type {Change[]} */ changes,
  /** @type {string | null} */ subject,
) {
  const uids = new Set(state.labels.map(({ uid }) => uid));
  const isGone = (/** @type {Change} */ { uid }) => uid !== undefined && !uids.has(uid);
  const present = changes.map((change) => (change.kind === "edit" && isGone(change) ? asNew(change) : change));
  const fitting = present.filter((change) => !isGone(change));
  if (fitting.length === 0) throw new Error("The box was deleted elsewhere.");
  return { changes: fitting, subject: subject !== null && uids.has(subject) ? subject : null };
}

/** The change that adds an edited box again, as a new one, after others have deleted it. @returns {Change} */
const asNew = (/** @type {Change} */ { label, box, track_id }) => ({ kind: "create", label, box, track_id });

/** The operator's version of a frame. @returns {Mine} */
export function versionOf(/** @type {FrameState} */ theirs, /** @type {Change[]} */ changes) {
  const labels = new Map(theirs.labels.map((label) => [label.uid, label]));
  const camera = cameraOf(theirs.image);
  const boxes = changes.flatMap(({ box, uid }) => box ?? labels.get(uid ?? "")?.box ?? []);
  const text = changes.map(({ kind, uid, label }) =>
    [label ?? labels.get(uid ?? "")?.label, VERBS[kind] ?? kind].filter(Boolean).join(": "),
  );
  return { text, boxes: [], outlines: boxes.map((box) => outline(camera, box).flatMap(pairs)) };
}

const pairs = (/** @type {Line} */ line) => line.slice(1).map((end, i) => [line[i], end]);

// -- a track has one box in a frame: the operator chooses which one stays

/**
 * The changes to send in place of refused ones, perhaps none, and the box to select then, if another one; null if the
 * refused ones stay unsaved.
 *
 * @param {PageLabel[]} labels of the frame, as stored.
 * @param {Change[]} changes the refused ones.
 * @param {TrackTakenError} error
 * @param {string} [name] of the frame, if it is not the open one.
 * @returns {Promise<{ changes: Change[], selected?: string } | null>}
 */
export async function chooseBox(labels, changes, error, name) {
  const { track } = error.body;
  const isOwn = (/** @type {string} */ uid) => changes.some((change) => change.uid === uid);
  const other = labels.find((label) => label.track_id === track && label.state !== "rejected" && !isOwn(label.uid));
  if (!other || changes.length !== 1) return null;
  const chosen = await openDialog({
    title: `Track ${track} has a box in ${name === undefined ? "this frame" : `frame ${name}`}`,
    testid: "which-stays",
    content: [
      h(
        "p",
        `The other box is ${other.state === "proposed" ? "a proposal" : other.state} (${other.label}). An object ` +
          "has one box in a frame: if both are the same object, choose the one that stays; the other one is deleted.",
      ),
    ],
    // Enter, which has just ended the track's number, deletes nothing
    actions: [
      { label: "Keep this box", value: "this", kind: "" },
      { label: "Keep the other box", value: "other", kind: "" },
      { label: "Cancel", value: "neither" },
    ],
  });
  const { uid, kind } = changes[0];
  if (chosen === "this") return { changes: [{ kind: "delete", uid: other.uid }, ...changes] };
  if (chosen === "other") {
    // a new box is not stored, and a rejected one stays rejected
    const isGone = uid === undefined || kind === "accept";
    return { changes: isGone ? [] : [{ kind: "delete", uid }], selected: other.uid };
  }
  // the track, or the state, stays as it was; a changed box is not lost
  return kind === "track" || kind === "accept" ? { changes: [] } : null;
}
