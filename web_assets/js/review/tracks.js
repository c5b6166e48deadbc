/**
 * The track of an object: a strip with its boxes, steps to the next and previous one, its box copied to the next
 * frame, and proposals between two reviewed boxes. The server does the work (workflows/tracks).
 */

import { trackColor } from "../colors.js";
import { button, count, h, patch } from "../dom.js";
import { currentFrame } from "../frame_state.js";

/** A copy with fewer points inside stands on nothing. */
const LEAST_POINTS = 5;

/** Frames of an object that are shown around the current one. */
const SHOWN = 40;

/**
 * What to say about boxes that were copied from the previous frame, and how.
 *
 * @returns {[string, "good" | "warn"]}
 */
export function copiedText(/** @type {PageLabel[]} */ copies) {
  const empty = copies.filter(({ points }) => points < LEAST_POINTS);
  const what = `${count(copies.length, "box", "boxes")} copied from the previous frame, to be reviewed.`;
  if (empty.length === 0) return [what, "good"];
  const which = copies.length === 1 ? "It holds" : `${count(empty.length, "copy holds", "copies hold")}`;
  const few = empty.some(({ points }) => points > 0) ? "hardly any" : "no";
  return [`${what} ${which} ${few} points here: move or delete ${empty.length === 1 ? "it" : "them"}.`, "warn"];
}

/**
 * `open` shows a box in its frame, `sheet` the contact sheet. `onCarried` is called when later proposals have changed.
 */
export function createTracks(
  /** @type {HTMLElement} */ host,
  /** @type {ModeApp} */ app,
  /** @type {Desk} */ desk,
  /** @type {{ open: (target: Target) => unknown, sheet: () => unknown, onCarried: () => unknown }} */ {
    open,
    sheet,
    onCarried,
  },
) {
  const title = h("span", { class: "grow ellipsis" });
  const fill = button(["Fill back", h("kbd", {}, "I")], () => void interpolate(), {
    title: "Propose boxes between this reviewed box and its track's previous reviewed box (I)",
    "data-testid": "act-fill",
  });
  const all = button("Sheet", () => sheet(), {
    title: "All boxes of this track as small pictures, to be accepted together (S)",
    "data-testid": "act-sheet",
  });
  const alike = button(["Alike", h("kbd", {}, "A")], () => void carry(), {
    title: "Correct the later proposals of this track like this box (A)",
    "data-testid": "act-carry",
  });
  const strip = h("div", { class: "track-strip", "data-testid": "track-strip" });
  const body = h(
    "div",
    { class: "track", hidden: true },
    h("div", { class: "row pad" }, title, all, alike, fill),
    strip,
  );
  host.append(body);
  /** @type {{ key: string, boxes: Api.TrackBox[] }} */
  let known = { key: "", boxes: [] };

  const recording = () => currentFrame(app).frame.recording;
  const path = (/** @type {number} */ id) => app.path("recordings", recording(), "tracks", id);

  async function show() {
    const { shown: label } = desk;
    const frame = app.state.frame?.frame;
    const id = desk.stored()?.track_id ?? null;
    const isHidden = !label || !frame || id === null;
    body.hidden = isHidden;
    if (isHidden) {
      known = { key: "", boxes: [] };
      return;
    }
    const key = `${frame.recording}/${id}/${frame.id}/${frame.revision}`;
    if (known.key === key) return draw(label, id);
    known = { key, boxes: [] };
    try {
      /** @type {Api.TrackBox[]} */
      const boxes = await app.api.get(path(id));
      if (known.key !== key) return;
      known.boxes = boxes;
      draw(label, id);
    } catch (error) {
      app.toast(error);
    }
  }

  function draw(/** @type {PageLabel} */ label, /** @type {number} */ id) {
    const at = Math.max(
      0,
      known.boxes.findIndex(({ uid }) => uid === label.uid),
    );
    const from = Math.max(0, Math.min(at - SHOWN / 2, known.boxes.length - SHOWN));
    const frames = new Set(known.boxes.filter(({ state }) => state !== "rejected").map(({ frame }) => frame)).size;
    title.textContent = `Track ${id} (${frames})`;
    title.title = `In ${count(frames, "frame")} of this recording`;
    title.style.color = trackColor(id);
    alike.disabled = desk.formerBox(label.uid) === null;
    fill.disabled = label.state !== "accepted" && label.state !== "edited";
    patch(
      strip,
      known.boxes.slice(from, from + SHOWN).map((box) =>
        button([], () => open({ frame: box.frame, uid: box.uid }), {
          class: `tick state-${box.state}`,
          title: `${box.key}, ${box.state}`,
          "aria-label": `Frame ${box.key}, ${box.state}`,
          "aria-current": box.uid === label.uid ? "true" : null,
          "data-testid": "track-tick",
          "data-uid": box.uid,
          "data-key": box.uid,
        }),
      ),
    );
  }

  /** Goes to the next (by = 1) or previous (by = -1) frame with the same object. */
  async function step(/** @type {number} */ by) {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null)
      return app.toast("This box has no track yet. Type a number in its field Track.", "warn");
    try {
      const index = currentFrame(app).frame.index ?? 0;
      /** @type {Api.TrackBox[]} */
      const boxes = await app.api.get(path(label.track_id));
      const others = boxes.filter(
        (box) => box.index !== null && box.state !== "rejected" && (by > 0 ? box.index > index : box.index < index),
      );
      const next = by > 0 ? others[0] : others[others.length - 1];
      if (next) await open({ frame: next.frame, uid: next.uid });
      else app.toast(by > 0 ? "No later frame has this object." : "No earlier frame has this object.");
    } catch (error) {
      app.toast(error);
    }
  }

  /** Copies the selected box to the next frame, and goes there. */
  async function copyToNext() {
    const label = desk.stored();
    if (!label || label.isNew) return;
    await desk.flush();
    try {
      /** @type {Api.CopyNextOut} */
      const done = await desk.change("copy-next", () => ({ uid: label.uid }));
      await open(done);
      const copies = desk.labels().filter(({ uid }) => uid === done.uid);
      app.toast(...copiedText(copies));
    } catch (error) {
      app.toast(error);
    }
  }

  /** Proposes boxes in the frames between this reviewed box and its track's previous reviewed box. */
  async function interpolate(refit = false) {
    const label = desk.stored();
    if (!label || label.isNew) return;
    await desk.flush();
    try {
      const { state, ...done } = await desk.change("interpolate", () => ({ uid: label.uid, refit }));
      app.frames.take(state);
      const left = done.finalised + done.covered;
      app.toast(
        `${count(done.filled, "frame")} filled between the two boxes${left > 0 ? `, ${left} left unchanged` : ""}.`,
        "good",
      );
      known.key = "";
      await show();
    } catch (error) {
      app.toast(error);
    }
  }

  /** Corrects the later proposals of the track like the selected box. */
  async function carry() {
    const label = desk.stored();
    if (!label || label.isNew) return;
    await desk.flush();
    const was = desk.formerBox(label.uid);
    if (was === null) return app.toast("Correct this box first; then A corrects the later ones alike.", "warn");
    try {
      /** @type {Api.CarryOut} */
      const { changed } = await desk.change("carry", () => ({ uid: label.uid, was }));
      app.toast(`${count(changed, "later box", "later boxes")} corrected alike.`, "good");
      refresh();
      await onCarried();
    } catch (error) {
      app.toast(error);
    }
  }

  /** Reads the track again, since other frames may have got boxes. */
  function refresh() {
    if (known.key === "") return;
    known.key = "";
    void show();
  }

  return { show, refresh, step, copyToNext, carry, interpolate };
}
