/**
 * Loads what the queue's next box shows while the operator looks at this one: its frame, and its three pictures. The
 * server reads the frame, and the browser keeps the pictures.
 */

import { sameBox } from "../box3d.js";
import { SIZE_PX } from "./ortho_views.js";

/**
 * @param {App} app
 * @param {Desk} desk
 * @param {Queue} queue
 */
export function createPreload(app, desk, queue) {
  /** @type {{ frame: number, box: Box3D, views: Api.OrthoOut } | null} */
  let ahead = null;
  /** @type {AbortController | null} */
  let request = null;

  /** Loads the next box; a problem is shown when the box itself is opened. */
  async function start() {
    const next = desk.uid === null ? null : queue.after(desk.uid);
    if (!next) return;
    request?.abort();
    request = new AbortController();
    const { signal } = request;
    try {
      const known = app.state.frame;
      /** @type {FrameState} */
      const state =
        known?.frame.id === next.frame ? known : await app.api.get(app.path("frames", next.frame), { signal });
      const box = state.labels.find(({ uid }) => uid === next.uid)?.box;
      if (state !== known) show(state.image.url);
      if (!box || (ahead && ahead.frame === next.frame && sameBox(ahead.box, box))) return;
      const path = app.path("frames", next.frame, "ortho");
      /** @type {Api.OrthoOut} */
      const views = await app.api.post(path, { box, size_px: SIZE_PX }, { signal });
      ahead = { frame: next.frame, box, views };
      for (const { url } of views.views) show(url);
      // the server keeps what it has drawn
      if (state !== known) await app.api.lines(app.path("frames", next.frame, "sheet"), () => {}, { signal });
    } catch {
      // not ahead, then
    }
  }

  return {
    start,
    stop: () => request?.abort(),

    /**
     * The pictures of a box, if they are loaded.
     *
     * @param {number} frame
     * @param {Box3D} box
     */
    take: (frame, box) => (ahead && ahead.frame === frame && sameBox(ahead.box, box) ? ahead.views : null),
  };
}

/**
 * Lets the browser keep a picture.
 *
 * @param {string} url
 */
function show(url) {
  new Image().src = url;
}
