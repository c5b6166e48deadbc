/** If a track would get a second box in a frame, the operator chooses which of the two stays. */

import { openDialog } from "../dialogs.js";
import { h } from "../dom.js";

/**
 * The changes to send in place of refused ones, perhaps none, and the box to select then, if another one; null if the
 * refused ones stay unsaved.
 *
 * @param {PageLabel[]} labels of the frame, as stored.
 * @param {Change[]} changes the refused ones.
 * @param {TrackTakenError} error
 * @returns {Promise<{ changes: Change[], selected?: string } | null>}
 */
export async function chooseBox(labels, changes, error) {
  const { track } = error.body;
  const isOwn = (/** @type {string} */ uid) => changes.some((change) => change.uid === uid);
  const other = labels.find((label) => label.track_id === track && label.state !== "rejected" && !isOwn(label.uid));
  if (!other || changes.length !== 1) return null;
  const chosen = await openDialog({
    title: `Track ${track} has a box in this frame`,
    testid: "which-stays",
    content: [
      h(
        "p",
        {},
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
