/** Opens frames one after the other, and loads what others save in the open one. */

import { count } from "../dom.js";
import { isAborted, messageOf } from "../errors.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { currentFrame } from "../frame_state.js";
import { makeHash } from "../router.js";
import { itemsOf, sameBox, sameItem } from "./items.js";

const WIDE_ASPECT = 1.9;
const BUSY_WAIT_MS = 300;

/**
 * @param {ModeApp} app
 * @param {Work} work
 * @param {{ order: Order, saver: Saver, suggester: Suggester, whole: WholeBoxes, prefetch: Prefetch, objects: Objects,
 *     editors: Editor[], image: Editor, imageHost: HTMLElement, page: HTMLElement, hint: HTMLElement,
 *     show: () => void }} parts
 */
export function createFrames(app, work, parts) {
  const { order, saver, suggester, whole, prefetch, objects, editors, image, imageHost, page, hint, show } = parts;

  let isFirst = true;
  /**
   * The frame that cannot be read.
   *
   * @type {number | null}
   */
  let broken = null;
  const problem = createFrameProblem(imageHost, { onRetry: retry, onStep: (which) => void go(which) });

  async function openRoute(/** @type {Route} */ route) {
    prefetch.stop();
    let frame = null;
    try {
      frame = route.frame ?? (await order.next());
      if (frame === null) {
        app.toast("No frame is left to label.", "warn");
        return;
      }
      if (route.frame === null) {
        history.replaceState(null, "", makeHash(app.state.project.name, "label", frame));
        app.state.set({ route: { ...route, frame } });
      }
      if (work.frameShown !== null && work.frameShown !== frame && !(await app.mayLeave())) {
        app.stay(work.frameShown);
        return;
      }
      await saver.idle();
      // app.state may still have an old state from another mode
      if (isFirst || app.state.frame?.frame.id !== frame) await app.loadFrame(frame);
      else onFrame(app.state.frame);
      isFirst = false;
      problem.hide();
      takeGiven(frame);
    } catch (error) {
      if (isAborted(error) || !page.isConnected) return;
      if (frame === null) app.toast(error);
      else fail(error, frame);
    }
  }

  /** Handles a frame that cannot be read: the panels show the reason in place of its pictures. */
  function fail(/** @type {unknown} */ error, /** @type {number} */ frame) {
    work.frameShown = null;
    broken = frame;
    order.opened(frame);
    objects.close();
    Object.assign(work, { items: [], selected: null, notSaved: [], detections: [] });
    hint.textContent = "";
    problem.show(error);
    show();
    // the 3D view shows the server's message, too
    app.viewport.show({ frame });
  }

  function retry() {
    void openRoute({ ...app.state.route, frame: broken });
  }

  async function beside(/** @type {Direction} */ direction) {
    if (app.state.frame) return direction === "next" ? order.next() : order.previous();
    return direction === "next" && order.by === "teach" ? order.next() : broken && frameBeside(app, broken, direction);
  }

  /** Takes an object whose first drag was made in Review. */
  function takeGiven(/** @type {number} */ frame) {
    const { given } = app;
    app.given = null;
    // frame ids are unique only within a project
    const isMine = given?.project === app.state.route.project && given.frame === frame;
    if (isMine && !work.isReadonly) objects.onImageChange([given.image_box], "draw", 0, 1);
  }

  /** The frame's state was set: a new frame, an undo, or a change by others. Changes of this page are for onSaved. */
  function onFrame(/** @type {FrameState | null} */ state) {
    if (!state) return;
    const isNew = work.frameShown !== state.frame.id;
    if (saver.isBusy && !isNew) return;
    if (isNew) begin(state);
    rebuild(state);
    if (isNew) app.events.openFrame(state.frame.id);
  }

  function begin(/** @type {FrameState} */ state) {
    const { id } = state.frame;
    work.frameShown = id;
    order.opened(id);
    objects.close();
    work.notSaved = [];
    work.detections = [];
    void suggestOnImage(id);
    const { url, width, height } = state.image;
    page.classList.toggle("wide-image", width / height > WIDE_ASPECT);
    prefetch.stop();
    void image.setPicture(url, width, height).then((isShown) => {
      if (isShown && page.isConnected && work.frameShown === id) prefetch.start();
    });
    image.fit();
  }

  /** Shows the boxes that the image detector finds, if there is a detector. */
  async function suggestOnImage(/** @type {number} */ frame) {
    if (!app.state.project?.detectors.image || work.isReadonly) return;
    const boxes = await suggester.onImage(frame);
    if (work.frameShown !== frame) return;
    work.detections = boxes;
    show();
  }

  function rebuild(/** @type {FrameState} */ state) {
    work.items = itemsOf(state);
    if (work.draft) {
      const known = work.draft.item;
      const index = work.items.findIndex(
        (item) => sameBox(item.image_box, known.stored) || (item.uid && item.uid === known.uid),
      );
      if (index < 0) objects.close();
      else if (sameItem(work.items[index], known)) keepCurrent(index);
      else objects.open(work.items[index]);
    }
    show();
  }

  function keepCurrent(/** @type {number} */ index) {
    if (!work.draft) return;
    work.draft.item.uid = work.items[index].uid;
    work.items[index] = work.draft.item;
    // the confirmation of its whole box may have been undone
    void whole.follow(work.draft);
  }

  function onSaved(/** @type {FrameState} */ state) {
    const fresh = itemsOf(state);
    // this page's boxes are newer than any answer; the server adds uids and the boxes of others
    work.items = fresh.map((item) => work.items.find((known) => sameBox(known.stored, item.image_box)) ?? item);
    work.items.forEach((item, i) => {
      item.uid = fresh[i].uid;
    });
    if (work.draft && !work.items.includes(work.draft.item)) objects.close();
    show();
  }

  /** Others have saved: reads their state, but not during a drag or while saving (label.js asks again after that). */
  async function refresh() {
    if (!app.frames.isBehind || saver.isBusy || !page.isConnected) return;
    if (!isDrawing()) await app.frames.refresh(() => !saver.isBusy && !isDrawing());
    if (app.frames.isBehind) setTimeout(refresh, BUSY_WAIT_MS);
  }

  const isDrawing = () => Boolean(work.draft?.isLoading) || editors.some((editor) => editor.isDragging);

  async function go(/** @type {Direction} */ direction) {
    prefetch.stop();
    if (!(await app.mayLeave())) return;
    const frame = await beside(direction);
    if (frame === null || frame === undefined)
      app.toast(direction === "next" ? "This is the last frame." : "This is the first frame.", "warn");
    else app.go(makeHash(app.state.route.project, "label", frame));
  }

  function setOrder(/** @type {OrderName} */ value) {
    order.by = value;
    prefetch.restart();
    show();
  }

  async function flush() {
    for (const editor of editors) editor.flush();
    // a moved image box is saved with the views that follow from it
    await work.loaded;
    await saver.idle();
  }

  /** What would be lost if the frame were left now; null if everything is saved. */
  function unsaved() {
    const isSent = work.items.every(({ stored, image_box }) => sameBox(stored, image_box));
    if (!saver.isBusy && isSent) return null;
    const text = `Not saved: ${count(saver.waiting, "change")} of this frame. ${saver.problem?.message ?? ""}`.trim();
    return { text, retry: saver.retry, discard };
  }

  function discard() {
    saver.discard();
    // this discards what was drawn, too
    app.frames.take(currentFrame(app));
  }

  return { openRoute, onFrame, onSaved, refresh, go, setOrder, flush, unsaved, discard };
}

// -- which frame is next: the most useful one for training, or the next in time

const KEPT = "label-order";

export function createOrder(/** @type {App} */ app) {
  /** @type {number[]} */
  const visited = [];
  /** @type {number | null} */
  let remaining = null;
  /** @type {OrderName} */
  let by = localStorage.getItem(KEPT) === "time" ? "time" : "teach";

  /** @param {RequestOptions} [options] */
  async function teaching(options) {
    const current = app.state.frame?.frame.id ?? null;
    /** @type {Api.QueueOut} */
    const { items, remaining: count } = await app.api.get(`${app.path("queue")}?order=teach`, options);
    remaining = count;
    const others = items.map(({ frame }) => frame).filter((frame) => frame !== current);
    return (
      others.find((frame) => !visited.includes(frame)) ?? others.find((frame) => frame !== visited.at(-1)) ?? null
    );
  }

  async function firstFrame() {
    return app.api.get(app.path("first-frame"));
  }

  return {
    get by() {
      return by;
    },
    set by(value) {
      by = value;
      localStorage.setItem(KEPT, value);
    },
    /** The number of frames in the queue at the latest request; null before the first one. */
    get remaining() {
      return remaining;
    },
    /**
     * The id of the first frame, or of the next one; null if there is none. Does not open it.
     *
     * @param {RequestOptions} [options]
     */
    async next(options) {
      if (by === "time" && app.state.frame) return app.state.frame.frame.next;
      return (
        (by === "teach" ? await teaching(options) : null) ??
        (app.state.frame ? app.state.frame.frame.next : firstFrame())
      );
    },
    /** The id of the previous frame in time, or of the one that was open before. */
    previous() {
      const current = app.state.frame?.frame;
      if (by === "time" || visited.length < 2) return current?.previous ?? null;
      visited.pop();
      return visited.pop() ?? null;
    },
    /** Records that a frame was opened. */
    opened(/** @type {number} */ frame) {
      if (visited.at(-1) !== frame) visited.push(frame);
      if (visited.length > 500) visited.shift();
    },
  };
}

// -- the next frame, loaded ahead

const IDLE_WAIT_MS = 300;

/** requestIdleCallback, or a pause if the browser lacks it. */
function whenIdle(/** @type {() => void} */ run) {
  if ("requestIdleCallback" in globalThis) {
    const id = requestIdleCallback(run);
    return () => cancelIdleCallback(id);
  }
  const id = setTimeout(run, IDLE_WAIT_MS);
  return () => clearTimeout(id);
}

export function createPrefetch(/** @type {App} */ app, /** @type {Order} */ order) {
  /** @type {(() => void) | null} */
  let cancel = null;
  /**
   * The frame whose next frame was read.
   *
   * @type {number | null}
   */
  let doneFor = null;

  async function run(/** @type {number} */ shown, /** @type {AbortSignal} */ signal) {
    try {
      const next = await order.next({ signal });
      if (next !== null && next !== shown && !signal.aborted) {
        /** @type {FrameState} */
        const { image } = await app.api.get(app.path("frames", next), { signal });
        // once read to its end, it is in the browser's cache
        const picture = await fetch(image.url, { signal, priority: "low", credentials: "same-origin" });
        await picture.blob();
      }
      doneFor = shown;
    } catch (error) {
      // the problem is shown when that frame is opened
      if (!isAborted(error)) console.debug(`reading ahead: ${messageOf(error)}`);
    }
  }

  function stop() {
    cancel?.();
    cancel = null;
  }

  return {
    /** Begins as soon as the page is idle, once for each frame. */
    start() {
      stop();
      const shown = app.state.frame?.frame.id;
      if (shown === undefined || shown === doneFor) return;
      const request = new AbortController();
      const forget = whenIdle(() => void run(shown, request.signal));
      cancel = () => {
        forget();
        request.abort();
      };
    },
    /** Prefetches again after a change of the order, since another frame may be next. */
    restart() {
      doneFor = null;
      this.start();
    },
    stop,
  };
}
