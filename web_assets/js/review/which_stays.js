/** If a track would get a second box in a frame, the operator chooses which of the two stays. */

import { openDialog } from "../dialogs.js";
import { h } from "../dom.js";

/**
 * The changes to send in place of refused ones, perhaps none; null if the operator chooses neither box.
 *
 * @param {PageLabel[]} labels of the frame, as stored.
 * @param {Change[]} changes the refused ones.
 * @param {TrackTakenError} error
 * @returns {Promise<Change[] | null>}
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
        `The other box is ${other.state === "proposed" ? "a proposal" : other.state} (${other.label}). An object has one ` +
          "box in a frame: if both are the same object, choose the one that stays; the other one is deleted.",
      ),
    ],
    actions: [
      { label: "Cancel", value: "neither" },
      { label: "Keep the other box", value: "other", kind: "" },
      { label: "Keep this box", value: "this" },
    ],
  });
  if (chosen === "this") return [{ kind: "delete", uid: other.uid }, ...changes];
  if (chosen !== "other") return null;
  const { uid, kind } = changes[0];
  // a new box is not stored, and a rejected one stays rejected
  return uid === undefined || kind === "accept" ? [] : [{ kind: "delete", uid }];
}
