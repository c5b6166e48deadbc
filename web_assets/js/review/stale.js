/**
 * A change that came too late: somebody else has changed the frame first. Both versions are shown, and the operator says
 * which one stays; until then neither is lost.
 */

import { outline } from "../camera.js";
import { openDialog } from "../dialogs.js";
import { h, s } from "../dom.js";
import { STATE_COLORS } from "./drawing.js";

const VERBS = { accept: "accepted", reject: "rejected", delete: "deleted", edit: "edited", create: "added", finalise: "finalised the frame", reopen: "opened the frame again" };

/**
 * @param {ApiError} error with `body.state`, the frame as it is now.
 * @param {{changes: object[], take: (frame: object) => void}} mine what was sent, and what takes a new state of the frame.
 * @returns {Promise<boolean>} true where the frame is settled: theirs was kept, or mine was saved on top of it.
 */
export async function resolveStale(app, error, { changes, subject, take }) {
  const theirs = error.body.state;
  const choice = await openDialog({
    title: "Somebody else has changed this frame",
    content: [
      h("p", {}, "Your change was not saved, since it was based on an older version of the frame. Choose which one stays."),
      h("div", { class: "versions" }, version("What is there now", theirs, theirs.labels, describeTheirs(theirs, changes)), version("With your change", theirs, applied(theirs.labels, changes), changes.map(describeMine))),
    ],
    actions: [{ label: "Keep what is there now", value: "theirs" }, { label: "Save mine on top", value: "mine" }],
    wide: true,
    testid: "stale",
    async submit(value) {
      if (value === "mine") take(await sendAgain(app, theirs, changes, subject));
      return value;
    },
  });
  if (choice === null) return false;
  if (choice === "theirs") take(theirs);
  return true;
}

function sendAgain(app, theirs, changes, subject) {
  const uids = new Set(theirs.labels.map(({ uid }) => uid));
  const fitting = changes.map((change) => (change.kind === "edit" && !uids.has(change.uid) ? asNew(change) : change)).filter(({ uid }) => uid === undefined || uids.has(uid));
  if (fitting.length === 0) throw new Error("The box is not there any more, so there is nothing to save. Keep what is there now.");
  return app.api.change(app.path("frames", theirs.frame.id, "changes"), { revision: theirs.frame.revision, changes: fitting, subject: uids.has(subject) ? subject : null });
}

/** A box that somebody else has deleted meanwhile comes back as a new one. */
const asNew = ({ label, box, track_id }) => ({ kind: "create", label, box, track_id });

function applied(labels, changes) {
  const by_uid = new Map(changes.map((change) => [change.uid, change]));
  const changed = labels.flatMap((label) => {
    const change = by_uid.get(label.uid);
    if (!change) return [label];
    if (change.kind === "delete") return [];
    if (change.kind === "edit") return [{ ...label, box: change.box, label: change.label, state: "edited", mine: true }];
    return [{ ...label, state: change.kind === "accept" ? "accepted" : "rejected", mine: true }];
  });
  const known = new Set(labels.map(({ uid }) => uid));
  const back = changes.filter(({ kind, uid }) => kind === "create" || (kind === "edit" && !known.has(uid)));
  return [...changed, ...back.map((change) => ({ ...change, state: "edited", mine: true }))];
}

function version(title, frame, labels, notes) {
  const { url, width, height } = frame.image;
  const camera = { ...frame.image.camera, width, height };
  const picture = s("svg", { class: "picture", viewBox: `-0.5 -0.5 ${width} ${height}`, role: "img", "aria-label": title }, s("image", { href: url, x: -0.5, y: -0.5, width, height }));
  for (const label of labels) {
    const lines = label.mine ? outline(camera, label.box) : label.outline;
    const d = lines.map((points) => points.map((px, i) => `${i ? "L" : "M"}${px.join(" ")}`).join("")).join("");
    picture.append(s("path", { d, fill: "none", stroke: STATE_COLORS[label.state], "stroke-width": label.mine ? 3 : 1.5, "stroke-dasharray": label.state === "rejected" ? "6 5" : null }));
  }
  return h("figure", {}, h("figcaption", {}, h("strong", {}, title)), picture, h("ul", {}, notes.map((text) => h("li", {}, text))));
}

function describeTheirs(frame, changes) {
  const concerned = new Set(changes.map(({ uid }) => uid));
  const notes = frame.labels.filter(({ uid }) => concerned.has(uid)).map(({ label, state, author }) => `${label}: ${state}, last by ${author}`);
  return notes.length ? notes : ["Your box is not in it any more."];
}

const describeMine = ({ kind, label }) => `${label ? `${label}: ` : ""}${VERBS[kind] ?? kind} by you`;
