/** Opens frames one after the other, and loads what others save in the open one. */

import { count } from "../dom.js";
import { isAborted } from "../errors.js";
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

  /** @param {Route} route */
  async function openRoute(route) {
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

  /**
   * Handles a frame that cannot be read: the panels show the reason in place of its pictures.
   *
   * @param {unknown} error
   * @param {number} frame
   */
  function fail(error, frame) {
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

  /** @param {Direction} direction */
  async function beside(direction) {
    if (app.state.frame) return direction === "next" ? order.next() : order.previous();
    return direction === "next" && order.by === "teach" ? order.next() : broken && frameBeside(app, broken, direction);
  }

  /**
   * Takes an object whose first drag was made in Review.
   *
   * @param {number} frame
   */
  function takeGiven(frame) {
    const { given } = app;
    app.given = null;
    // frame ids are unique only within a project
    const isMine = given?.project === app.state.route.project && given.frame === frame;
    if (isMine && !work.isReadonly) objects.onImageChange([given.image_box], "draw", 0, 1);
  }

  /**
   * The frame's state was set: a new frame, an undo, or a change by others. Changes of this page are for onSaved.
   *
   * @param {FrameState | null} state
   */
  function onFrame(state) {
    if (!state) return;
    const isNew = work.frameShown !== state.frame.id;
    if (saver.isBusy && !isNew) return;
    if (isNew) begin(state);
    rebuild(state);
    if (isNew) app.events.openFrame(state.frame.id);
  }

  /** @param {FrameState} state */
  function begin(state) {
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

  /**
   * Shows the boxes that the image detector finds, if there is a detector.
   *
   * @param {number} frame
   */
  async function suggestOnImage(frame) {
    if (!app.state.project?.detectors.image || work.isReadonly) return;
    const boxes = await suggester.onImage(frame);
    if (work.frameShown !== frame) return;
    work.detections = boxes;
    show();
  }

  /** @param {FrameState} state */
  function rebuild(state) {
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

  /** @param {number} index */
  function keepCurrent(index) {
    if (!work.draft) return;
    work.draft.item.uid = work.items[index].uid;
    work.items[index] = work.draft.item;
    // the confirmation of its whole box may have been undone
    void whole.follow(work.draft);
  }

  /** @param {FrameState} state */
  function onSaved(state) {
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

  /** @param {Direction} direction */
  async function go(direction) {
    prefetch.stop();
    if (!(await app.mayLeave())) return;
    const frame = await beside(direction);
    if (frame === null || frame === undefined)
      app.toast(direction === "next" ? "This is the last frame." : "This is the first frame.", "warn");
    else app.go(makeHash(app.state.route.project, "label", frame));
  }

  /** @param {OrderName} value */
  function setOrder(value) {
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
