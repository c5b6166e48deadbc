/**
 * Loads what the queue's next box shows while the operator looks at this one: its frame, and its three pictures. The
 * server reads the frame, and the browser keeps the pictures. Then the server draws the beginning of the contact sheet
 * of this box's track, which may be opened next.
 */

import { sameBox } from "../box3d.js";
import { SIZE_PX } from "./ortho_views.js";

/** At least as many pictures of a contact sheet as a screen shows when it opens: 20 at 1366 x 768. */
const ON_SCREEN = 32;

export function createPreload(/** @type {App} */ app, /** @type {Desk} */ desk, /** @type {Queue} */ queue) {
  /** @type {{ frame: number, box: Box3D, views: Api.OrthoView[] } | null} */
  let ahead = null;
  /** @type {AbortController | null} */
  let request = null;
  /** Tracks of which the server has drawn the pictures, as "recording/track". @type {Set<string>} */
  const drawn = new Set();
  let isHeld = false;
  /** What the browser keeps decoded. @type {HTMLImageElement[]} */
  let pictures = [];

  function keep(/** @type {string[]} */ urls) {
    pictures = urls.map((url) => Object.assign(new Image(), { src: url }));
    for (const picture of pictures) picture.decode().catch(() => {});
  }

  async function start() {
    request?.abort();
    if (isHeld) return;
    request = new AbortController();
    await loadNext(request.signal);
    await drawSheet(request);
  }

  /** Loads the next box; a problem is shown when the box itself is opened. */
  async function loadNext(/** @type {AbortSignal} */ signal) {
    const next = desk.uid === null ? null : queue.after(desk.uid, app.state.frame?.frame.id);
    if (!next) return;
    try {
      const known = app.state.frame;
      /** @type {FrameState} */
      const state =
        known && desk.stored(next.uid)?.better_in === null
          ? known
          : await app.frames.prepare(next.frame, next.uid, { signal });
      const { id } = state.frame;
      const box = state.labels.find(({ uid }) => uid === next.uid)?.box;
      if (state !== known) keep([state.image.url]);
      if (!box || (ahead && ahead.frame === id && sameBox(ahead.box, box))) return;
      const path = app.path("frames", id, "ortho");
      const views = await app.api.post(path, { box, size_px: SIZE_PX }, { signal });
      ahead = { frame: id, box, views };
      keep([state.image.url, ...views.map(({ url }) => url)]);
      // the server keeps what it has drawn
      if (state !== known) await app.api.lines(app.path("frames", id, "sheet"), () => {}, { signal });
    } catch {
      // not ahead, then
    }
  }

  async function drawSheet(/** @type {AbortController} */ own) {
    const track = desk.stored()?.track_id ?? null;
    const recording = app.state.frame?.frame.recording;
    const name = `${recording}/${track}`;
    if (track === null || recording === undefined || drawn.has(name) || own.signal.aborted) return;
    let pictures = 0;
    const take = () => {
      pictures += 1;
      if (pictures < ON_SCREEN) return;
      drawn.add(name);
      own.abort();
    };
    try {
      await app.api.lines(app.path("recordings", recording, "tracks", track, "sheet"), take, { signal: own.signal });
      drawn.add(name);
    } catch {
      // the sheet itself shows a problem
    }
  }

  return {
    start,
    stop: () => request?.abort(),

    /** Loads nothing ahead until the returned function is called: the server has something to draw that is awaited. */
    hold() {
      isHeld = true;
      request?.abort();
      return () => {
        isHeld = false;
        void start();
      };
    },

    /** The pictures of a box, if they are loaded. */
    take: (/** @type {number} */ frame, /** @type {Box3D} */ box) =>
      ahead && ahead.frame === frame && sameBox(ahead.box, box) ? ahead.views : null,
  };
}
