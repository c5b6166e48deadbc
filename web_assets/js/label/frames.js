/** From frame to frame, and what others do to the one that is open. */

import { count } from "../dom.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { itemsOf, sameBox, sameItem } from "./items.js";

const WIDE_ASPECT = 1.9;
const BUSY_WAIT_MS = 300;

/** @param {object} parts {order, saver, suggester, prefetch, objects, editors, image, image_host, page, hint, show}. */
export function createFrames(app, work, parts) {
  const { order, saver, suggester, prefetch, objects, editors, image, image_host, page, hint, show } = parts;

  let is_first = true;
  let broken = null;
  const problem = createFrameProblem(image_host, { onRetry: retry, onStep: (which) => void go(which) });

  async function openRoute(route) {
    prefetch.stop();
    let frame = null;
    try {
      frame = route.frame ?? (await order.next());
      if (frame === null) {
        app.toast("There is no frame left to label.", "warn");
        return;
      }
      if (route.frame === null) {
        history.replaceState(null, "", makeHash(route.project, "label", frame));
        app.state.set({ route: { ...route, frame } });
      }
      if (work.frame_shown !== null && work.frame_shown !== frame && !(await app.mayLeave())) {
        app.stay(work.frame_shown);
        return;
      }
      await saver.idle();
      // what another mode has left in app.state may be old
      if (is_first || app.state.frame?.frame.id !== frame) await app.loadFrame(frame);
      else onFrame(app.state.frame);
      is_first = false;
      problem.hide();
      takeGiven(frame);
    } catch (error) {
      if (error.name === "AbortError" || !page.isConnected) return;
      if (frame === null) app.toast(error);
      else fail(error, frame);
    }
  }

  /** A frame that cannot be read: the panels say so in place of its pictures. */
  function fail(error, frame) {
    work.frame_shown = null;
    broken = frame;
    order.opened(frame);
    objects.close();
    Object.assign(work, { items: [], selected: null, not_saved: [], found: [] });
    hint.textContent = "";
    problem.show(error);
    show();
    // the 3D view has the server's message, too
    app.viewport.show({ frame });
  }

  function retry() {
    void openRoute({ ...app.state.route, frame: broken });
  }

  async function beside(direction) {
    if (app.state.frame) return direction === "next" ? order.next() : order.previous();
    return direction === "next" && order.by === "teach" ? order.next() : frameBeside(app, broken, direction);
  }

  /** The first drag of an object was made in Review. */
  function takeGiven(frame) {
    const { given } = app;
    app.given = null;
    // frames count from 1 in each project
    const is_mine = given?.project === app.state.route.project && given.frame === frame;
    if (is_mine && !work.is_readonly) objects.onImageChange([given.image_box], "draw", 0, 1);
  }

  /** Somebody set the frame's state: a new frame, an undo, another operator. Own savings come through onSaved. */
  function onFrame(state) {
    if (!state) return;
    const is_new = work.frame_shown !== state.frame.id;
    if (saver.isBusy && !is_new) return;
    if (is_new) begin(state);
    rebuild(state);
    if (is_new) app.events.openFrame(state.frame.id);
  }

  function begin(state) {
    const { id } = state.frame;
    work.frame_shown = id;
    order.opened(id);
    objects.close();
    work.not_saved = [];
    work.found = [];
    void suggestOnImage(id);
    const { url, width, height } = state.image;
    page.classList.toggle("wide-image", width / height > WIDE_ASPECT);
    prefetch.stop();
    image.setPicture(url, width, height).then((is_shown) => is_shown && page.isConnected && work.frame_shown === id && prefetch.start());
    image.fit();
  }

  /** What the image detector finds, to begin with; without it there is nothing. */
  async function suggestOnImage(frame) {
    if (!app.state.project?.detectors.image || work.is_readonly) return;
    const boxes = await suggester.onImage(frame);
    if (work.frame_shown !== frame) return;
    work.found = boxes;
    show();
  }

  function rebuild(state) {
    work.items = itemsOf(state);
    if (work.draft) {
      const known = work.draft.item;
      const index = work.items.findIndex((item) => sameBox(item.image_box, known.stored) || (item.uid && item.uid === known.uid));
      if (index < 0) objects.close();
      else if (sameItem(work.items[index], known)) keepCurrent(index);
      else objects.open(work.items[index]);
    }
    show();
  }

  function keepCurrent(index) {
    work.draft.item.uid = work.items[index].uid;
    work.items[index] = work.draft.item;
  }

  function onSaved(state) {
    const fresh = itemsOf(state);
    // What is drawn here is newer than any answer; the server adds uids and other people's boxes.
    work.items = fresh.map((item) => work.items.find((known) => sameBox(known.stored, item.image_box)) ?? item);
    work.items.forEach((item, i) => (item.uid = fresh[i].uid ?? null));
    if (work.draft && !work.items.includes(work.draft.item)) objects.close();
    show();
  }

  /** Others have saved: read it, but not over what is being drawn or saved; saver's end asks again (label.js). */
  async function refresh() {
    if (!app.frames.isBehind || saver.isBusy || !page.isConnected) return;
    if (!isDrawing()) await app.frames.refresh(() => !saver.isBusy && !isDrawing());
    if (app.frames.isBehind) setTimeout(refresh, BUSY_WAIT_MS);
  }

  const isDrawing = () => Boolean(work.draft?.is_loading) || editors.some((editor) => editor.isDragging);

  async function go(direction) {
    prefetch.stop();
    if (!(await app.mayLeave())) return;
    const frame = await beside(direction);
    if (frame === null || frame === undefined) app.toast(direction === "next" ? "This is the last frame." : "This is the first frame.", "warn");
    else app.go(makeHash(app.state.route.project, "label", frame));
  }

  function setOrder(value) {
    order.by = value;
    prefetch.restart();
    show();
  }

  async function flush() {
    editors.forEach((editor) => editor.flush());
    // a moved image box is saved with the views that it leads to
    await work.loaded;
    await saver.idle();
  }

  /** What is lost where the frame is left now; null where all is saved. */
  function unsaved() {
    const is_told = work.items.every(({ stored, image_box }) => sameBox(stored, image_box));
    if (!saver.isBusy && is_told) return null;
    const text = `${count(saver.waiting, "change")} of this frame not saved. ${saver.problem?.message ?? ""}`.trim();
    return { text, retry: saver.retry, discard };
  }

  function discard() {
    saver.discard();
    // what was drawn goes with it
    app.frames.take(app.state.frame);
  }

  return { openRoute, onFrame, onSaved, refresh, go, setOrder, flush, unsaved };
}
