/** Opens frames, and selects a box in each. */

import { ApiError, isAborted } from "../errors.js";
import { frameBeside } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { isOpen } from "./desk.js";

/** The frame that was taken from the queue last, with its project; it stays so when the page is loaded again. */
const FROM_QUEUE = "frame-from-queue";
/** What is not looked at comes so long after a frame was opened, ms. */
export const REST_MS = 300;

/**
 * @param {ModeApp} app
 * @param {object} parts
 * @param {Desk} parts.desk
 * @param {Queue} parts.queue
 * @param {() => void} parts.onLoading called when opening a frame begins or ends, also if it cannot be read.
 * @param {(error: unknown, frame: number | null) => void} parts.onProblem called with the reason why a frame cannot be
 *     read, or with null.
 */
export function createOpening(app, { desk, queue, onLoading, onProblem }) {
  const { project } = app.state.route;
  let loading = false;
  let openings = 0;
  /** In which the operator has stepped last. @type {Direction} */
  let direction = "next";
  /** The frame that is shown. @type {number | null} */
  let opened = null;
  /** The frame that cannot be read. @type {number | null} */
  let broken = null;

  /** Sets whether a frame is being opened; keys must not act meanwhile, because its boxes are not shown yet. */
  function setLoading(/** @type {boolean} */ value) {
    loading = value;
    onLoading();
  }

  /**
   * Opens a frame, and selects the label, or else the track. Resolves to false if the operator stays with the open one,
   * to null if yet another one is opened.
   *
   * @param {number} id
   * @param {string | null} uid
   * @param {number | null} [track]
   * @param {boolean} [isAsItIs] no other camera of the moment is opened in its place, though it may see the label better.
   * @param {boolean} [isAtOnce] what is being saved is not waited for, and nothing else is unsaved.
   */
  async function open(id, uid, track = null, isAsItIs = true, isAtOnce = false) {
    openings += 1;
    const own = openings;
    setLoading(true);
    try {
      if (opened !== id && opened !== null && !isAtOnce && !(await app.mayLeave(id))) return false;
      if (!isAtOnce) await desk.flush();
      if (own !== openings) return null;
      // app.state may still have an old state from another mode
      if (opened !== id || !desk.stored(uid)) {
        desk.select(null);
        const { frame } = await app.loadFrame(id, isAsItIs ? null : uid);
        // the first one may be that of a page that was loaded again; `go` says if another one is the queue's, too
        if (opened !== frame.id && own > 1) sessionStorage.removeItem(FROM_QUEUE);
        opened = frame.id;
        showProblem(null);
      }
      pick(uid, track);
      // one that was read ahead is read again, when it is shown; its files may be damaged or gone by now
      const again = (/** @type {unknown} */ error) => {
        if (own !== openings || !(error instanceof ApiError && error.status > 0)) return app.toast(error);
        opened = null;
        void open(id, uid, track, isAsItIs);
      };
      setTimeout(() => own === openings && desk.refresh().catch(again), REST_MS);
    } catch (error) {
      if (own !== openings || isAborted(error)) return null;
      showProblem(error, id);
    } finally {
      if (own === openings) setLoading(false);
    }
    return true;
  }

  /** Shows the reason why a frame cannot be read, in place of its pictures; null: it can be read. */
  function showProblem(/** @type {unknown} */ error, /** @type {number | null} */ frame = null) {
    broken = frame;
    if (error !== null) opened = null;
    onProblem(error, frame);
  }

  /** Selects a label of the open frame: this one, or that of this track, or else the most doubtful proposal. */
  function pick(/** @type {string | null} */ uid, /** @type {number | null} */ track = null) {
    desk.select(chosen(desk.labels(), uid, track)?.uid ?? null);
  }

  /** True if a box is in the open frame, whose camera sees it as well as any. */
  const isShown = (/** @type {string | null} */ uid) => desk.stored(uid)?.better_in === null;

  /**
   * Opens a box where it is seen best, and puts its frame into the address.
   *
   * @param {Target} options
   * @param {boolean} [isFromQueue] it is the queue's next one, so that the queue goes on from here.
   * @param {boolean} [isAtOnce] as for `open`.
   */
  async function go({ frame, uid }, isFromQueue = false, isAtOnce = false) {
    if (isShown(uid)) desk.select(uid);
    else if (!(await open(desk.stored(uid)?.better_in ?? frame, uid, null, false, isAtOnce))) return;
    // an address without a frame would choose this one again if it cannot be read
    const shown = opened ?? broken;
    if (isFromQueue) sessionStorage.setItem(FROM_QUEUE, `${project}/${shown}`);
    app.go(makeHash(project, "annotate", shown));
  }

  /** Opens the next or previous frame in time; while the queue has frames to draw on, its next one. */
  async function step(/** @type {Direction} */ which) {
    direction = which;
    const useful = which === "next" && queue.order === "teach" ? queue.after(null, opened) : null;
    if (useful) return go(useful, true);
    const next = broken === null ? (app.state.frame?.frame[which] ?? null) : await frameBeside(app, broken, which);
    if (next === null)
      app.toast(which === "next" ? "This is the recording's last frame." : "This is the recording's first frame.");
    else app.go(makeHash(project, "annotate", next));
  }

  /** Opens the frame of the page's URL, or else the first one of the queue. */
  async function begin() {
    const { frame, query } = app.state.route;
    const track = trackIn(query);
    // the frame can be reviewed without the queue
    try {
      await queue.load();
    } catch (error) {
      app.toast(error);
    }
    if (frame !== null && track !== null) return open(frame, null, track);
    if (frame !== null)
      return open(frame, query.get("uid") ?? queue.items.find((item) => item.frame === frame)?.uid ?? null);
    if (queue.items[0]) return go(queue.items[0], true);
    const first = await app.api.get(app.path("first-frame"));
    if (first !== null) return go({ frame: first, uid: null });
  }

  return {
    get loading() {
      return loading;
    },
    /**
     * The operator works through the queue: the open frame was taken from it. Another one, which the operator has
     * chosen, is left only when asked.
     */
    get inQueue() {
      return sessionStorage.getItem(FROM_QUEUE) === `${project}/${opened}`;
    },
    /** Changes with each frame that the operator opens. */
    get openings() {
      return openings;
    },
    get opened() {
      return opened;
    },
    /** The frame that the next step in the same direction opens, or null. */
    get beside() {
      return app.state.frame?.frame[direction] ?? null;
    },
    get broken() {
      return broken;
    },
    setLoading,
    isShown,
    open,
    go,
    pick,
    step,
    begin,
  };
}

/** The track that an address names, or null. */
export const trackIn = (/** @type {URLSearchParams} */ query) =>
  query.has("track") ? Number(query.get("track")) : null;

/** The label that is selected when a frame opens: this one, or that of this track, or else the most doubtful proposal. */
export const chosen = (
  /** @type {PageLabel[]} */ labels,
  /** @type {string | null} */ uid,
  /** @type {number | null} */ track = null,
) =>
  labels.find((label) => label.uid === uid) ??
  labels.find((label) => track !== null && label.track_id === track && label.state !== "rejected") ??
  mostDoubtful(labels.filter(isOpen)) ??
  labels.find(({ state }) => state !== "rejected");

/** The most doubtful label, of those that the camera shows if there are any. */
export const mostDoubtful = (/** @type {PageLabel[]} */ labels) =>
  labels.toSorted(
    (a, b) => Number(b.better_in === null) - Number(a.better_in === null) || (b.doubt ?? 0) - (a.doubt ?? 0),
  )[0];
