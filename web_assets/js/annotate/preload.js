/**
 * Loads what may be shown next while the operator looks at a box: the frame of the queue's next box and the one beside
 * the open frame, with their pictures and those of the box that is selected there. The server reads the frames, the
 * browser keeps the pictures, and the 3D view the points of the likelier frame. Then the server draws the beginning of
 * the contact sheet of this box's track, which may be opened next.
 */

import { sameBox } from "../box3d.js";
import { chosen } from "./opening.js";
import { SIZE_PX } from "./ortho_views.js";

/** At least as many pictures of a contact sheet as a screen shows when it opens: 20 at 1366 x 768. */
const ON_SCREEN = 32;

/** Number of boxes of which the views are kept, and of pictures that the browser keeps decoded. */
const [MOST_VIEWS, MOST_PICTURES] = [4, 16];

export function createPreload(
  /** @type {Pick<ModeApp, "api" | "frames" | "path" | "state" | "viewport">} */ app,
  /** @type {Desk} */ desk,
  /** @type {Queue} */ queue,
  /** @type {Pick<Opening, "beside" | "inQueue">} */ opening,
) {
  /** The newest last. @type {{ frame: number, box: Box3D, views: Api.OrthoView[] }[]} */
  let ahead = [];
  /** @type {AbortController | null} */
  let request = null;
  /** Tracks of which the server has drawn the pictures, as "recording/track". @type {Set<string>} */
  const drawn = new Set();
  let isHeld = false;
  /** By address, the newest last. @type {Map<string, HTMLImageElement>} */
  const pictures = new Map();

  function keep(/** @type {string[]} */ urls) {
    for (const url of urls.filter((each) => !pictures.has(each))) {
      const picture = Object.assign(new Image(), { src: url });
      picture.decode().catch(() => {});
      pictures.set(url, picture);
    }
    for (const oldest of [...pictures.keys()].slice(0, -MOST_PICTURES)) pictures.delete(oldest);
  }

  async function start() {
    request?.abort();
    if (isHeld) return;
    request = new AbortController();
    const { signal } = request;
    try {
      // what is awaited goes first
      await app.viewport.idle();
      if (signal.aborted) return;
      for (const [index, target] of targets().entries()) await load(target, index === 0, signal);
    } catch {
      // not ahead, then; a problem is shown when the box itself is opened
    }
    await drawSheet(request);
  }

  /** What may be opened next, the likeliest first. @returns {Target[]} */
  function targets() {
    const next = queue.after(desk.uid, app.state.frame?.frame.id);
    const beside = opening.beside === null ? null : { frame: opening.beside, uid: null };
    const all = opening.inQueue ? [next, beside] : [beside, next];
    return all.filter((target) => target !== null);
  }

  async function load(
    /** @type {Target} */ { frame, uid },
    /** @type {boolean} */ isLikeliest,
    /** @type {AbortSignal} */ signal,
  ) {
    const known = app.state.frame;
    const isHere = known !== null && desk.stored(uid)?.better_in === null;
    const state = isHere ? known : await app.frames.prepare(frame, uid, { signal });
    const { id } = state.frame;
    keep([state.image.url]);
    if (!isHere && isLikeliest) app.viewport.prepare(id);
    const box = chosen(state.labels, uid)?.box;
    if (!box || viewsOf(id, box)) return;
    const views = await app.api.post(app.path("frames", id, "ortho"), { box, size_px: SIZE_PX }, { signal });
    ahead = [...ahead, { frame: id, box, views }].slice(-MOST_VIEWS);
    keep(views.map(({ url }) => url));
    // the server keeps what it has drawn
    if (!isHere) await app.api.lines(app.path("frames", id, "sheet"), () => {}, { signal });
  }

  const viewsOf = (/** @type {number} */ frame, /** @type {Box3D} */ box) =>
    ahead.find((known) => known.frame === frame && sameBox(known.box, box))?.views ?? null;

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
    take: viewsOf,
  };
}
