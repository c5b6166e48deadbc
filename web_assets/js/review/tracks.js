/**
 * An object over the recording: where its boxes are, to its next and previous one, on into the next frame, and what lies
 * between two reviewed boxes. All of it is the server's work (workflows/tracks); here are the keys, and a strip of its frames.
 */

import { trackColor } from "../colors.js";
import { count, h } from "../dom.js";
import { makeHash } from "../router.js";

/** So many frames of an object are shown around the present one. */
const SHOWN = 40;

/** `open({frame, uid})`: shows a box in its frame. */
export function createTracks(host, app, desk, { open }) {
  const title = h("span", { class: "grow ellipsis" });
  const fill = h("button", { type: "button", title: "Fill the frames between this reviewed box and its track's reviewed box before (I)", "data-testid": "act-fill", onclick: () => void interpolate() }, "Fill back", h("kbd", {}, "I"));
  const strip = h("div", { class: "track-strip", "data-testid": "track-strip" });
  const body = h("div", { class: "track", hidden: true }, h("div", { class: "row pad" }, title, fill), strip);
  host.append(body);
  let known = { key: "", boxes: [] };

  const recording = () => app.state.frame.frame.recording;
  const path = (track_id) => app.path("recordings", recording(), "tracks", track_id);

  async function show() {
    const { shown: label } = desk;
    const { frame } = app.state.frame ?? {};
    const track_id = desk.stored()?.track_id ?? null;
    body.hidden = !label || track_id === null;
    if (body.hidden) {
      known = { key: "", boxes: [] };
      return;
    }
    const key = `${frame.recording}/${track_id}/${frame.id}/${frame.revision}`;
    if (known.key === key) return draw(label, track_id);
    known = { key, boxes: [] };
    try {
      const { boxes } = await app.api.get(path(track_id));
      if (known.key !== key) return;
      known.boxes = boxes;
      draw(label, track_id);
    } catch (error) {
      app.toast(error);
    }
  }

  function draw(label, track_id) {
    const at = Math.max(0, known.boxes.findIndex(({ uid }) => uid === label.uid));
    const from = Math.max(0, Math.min(at - SHOWN / 2, known.boxes.length - SHOWN));
    title.textContent = `Track ${track_id} (${known.boxes.length})`;
    title.title = `${count(known.boxes.length, "box", "boxes")} in this recording`;
    title.style.color = trackColor(track_id);
    fill.disabled = label.state !== "accepted" && label.state !== "edited";
    strip.replaceChildren(
      ...known.boxes.slice(from, from + SHOWN).map((box) =>
        h("button", {
          type: "button", class: `tick state-${box.state}`, title: `${box.key}, ${box.state}`, "aria-label": `Frame ${box.key}, ${box.state}`,
          "aria-current": box.uid === label.uid ? "true" : null, "data-testid": "track-tick", "data-uid": box.uid, onclick: () => open({ frame: box.frame, uid: box.uid }),
        }),
      ),
    );
  }

  /** The same object in the next (by = 1) or previous (by = -1) frame that has it. */
  async function step(by) {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null) return app.toast("This box belongs to no track. Give it a track id, or run annotator track.", "warn");
    try {
      const { index } = app.state.frame.frame;
      const { boxes } = await app.api.get(path(label.track_id));
      const others = boxes.filter((box) => box.index !== null && box.state !== "rejected" && (by > 0 ? box.index > index : box.index < index));
      const next = by > 0 ? others[0] : others[others.length - 1];
      if (next) await open({ frame: next.frame, uid: next.uid });
      else app.toast(by > 0 ? "No later frame has this object." : "No earlier frame has this object.");
    } catch (error) {
      app.toast(error);
    }
  }

  /** Proposals in the next frame, from this frame's reviewed boxes; with a `uid` a copy of that box. Goes there. */
  async function follow(how, uid = null) {
    if (!app.state.frame) return;
    await desk.flush();
    const { id } = app.state.frame.frame;
    app.effort.action();
    try {
      const done = await desk.enqueue(() => app.api.change(app.path("frames", id, "follow"), { revision: app.state.frame.frame.revision, how, uid }));
      app.toast(told(done, how), done.lost > 0 ? "warn" : "good");
      app.go(makeHash(app.state.route.project, "review", done.frame));
    } catch (error) {
      await refused(error);
    }
  }

  /** Proposals in the frames between this reviewed box and its track's reviewed box before. */
  async function interpolate(refit = false) {
    const label = desk.stored();
    if (!label || label.is_new) return;
    await desk.flush();
    const { id } = app.state.frame.frame;
    app.effort.action();
    try {
      const { state, ...done } = await desk.enqueue(() => app.api.change(app.path("frames", id, "interpolate"), { revision: app.state.frame.frame.revision, uid: label.uid, refit }));
      app.frames.take(state);
      const left = done.finalised + done.covered;
      app.toast(`${count(done.filled, "frame")} filled between the two boxes${left > 0 ? `, ${left} left as they are` : ""}.`, "good");
      known.key = "";
      await show();
    } catch (error) {
      await refused(error);
    }
  }

  /** Nothing was changed. Where somebody was faster, their version is shown, to be looked at before it is tried again. */
  async function refused(error) {
    if (error.isStale) app.frames.take(error.body.state);
    app.toast(error, error.isStale ? "warn" : undefined);
  }

  return { show, step, follow, interpolate };
}

function told({ proposed, lost, how }, asked) {
  const text = `${count(proposed, "box", "boxes")} ${how === "copy" ? "copied" : "proposed"} from the frame before`;
  if (how !== asked) return `${text}: there are no detectors to look for objects yet.`;
  return lost > 0 ? `${text}; ${count(lost, "object")} not found again.` : `${text}.`;
}
