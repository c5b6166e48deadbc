/**
 * Whole boxes: once an object's visible part is drawn, the server offers boxes that the whole object may have. One of
 * them is shown dashed; Enter confirms it, another key shows the next one.
 */

import { plainBox } from "./items.js";

/** Enter confirms a box only after this time on the screen: before it, the key was meant for something else. */
const SEEN_MS = 300;

export function createWholeBoxes(/** @type {Work} */ work) {
  const { app, show, saver } = work;
  let request = new AbortController();

  /** The label of a draft's object, if its box encloses only what is seen. */
  function seenLabel(/** @type {Draft} */ { item }) {
    if (work.isReadonly || !item.boxes.every(Boolean)) return null;
    const label = app.state.frame?.labels.find(({ uid }) => uid === item.uid);
    return label?.box_kind === "silhouette" && label.state !== "rejected" ? label : null;
  }

  /** Asks for the whole boxes of an object, unless they are known already; `stop` or another call ends that. */
  async function follow(/** @type {Draft} */ draft) {
    request.abort();
    request = new AbortController();
    const { signal } = request;
    await saver.idle();
    if (signal.aborted || draft.whole?.changes === draft.changes || !seenLabel(draft)) return;
    const { changes } = draft;
    const path = app.path("frames", draft.frame, "label", "whole");
    const boxes = await app.api.post(path, { image_box: plainBox(draft.item.image_box) }, { signal });
    if (signal.aborted || draft.changes !== changes) return;
    draft.whole = { boxes, shown: 0, changes, since: performance.now() };
    show();
  }

  /** The box that is offered for the current object; null if there is none. */
  function offered() {
    const { draft } = work;
    const whole = draft?.whole;
    if (!draft || !whole || whole.changes !== draft.changes || !seenLabel(draft)) return null;
    return whole.boxes[whole.shown] ?? null;
  }

  /** Shows the next of the offered boxes; false if there is no other one. */
  function next() {
    const whole = work.draft?.whole;
    if (!offered() || !whole || whole.boxes.length < 2) return false;
    app.effort.action();
    whole.shown = (whole.shown + 1) % whole.boxes.length;
    show();
    return true;
  }

  /** Confirms the offered box; false if there is none, or not long enough to be seen. */
  function confirm() {
    const { draft } = work;
    const whole = offered();
    const label = draft && seenLabel(draft);
    if (!draft?.whole || !whole || !label) return false;
    // not long enough on the screen: the key was meant for something else
    if (performance.now() - draft.whole.since < SEEN_MS) return true;
    app.effort.action();
    draft.whole = null;
    const { uid, label: name, track_id } = label;
    const { box, outline } = whole;
    saver.save({
      path: ["changes"],
      item: draft.item,
      body: () => ({
        subject: uid,
        changes: [{ kind: "edit", uid, label: name, box, track_id, box_kind: "box" }],
      }),
      mine: () => ({ text: [`${name}: its whole box`], boxes: [], outlines: [outline] }),
    });
    show();
    return true;
  }

  return { follow, stop: () => request.abort(), offered, next, confirm };
}
