/** From frame to frame, and what others do to the one that is open. */

import { makeHash } from "../router.js";
import { itemsOf, sameBox, sameItem } from "./items.js";

const WIDE_ASPECT = 1.9;
const BUSY_WAIT_MS = 300;

/** @param {object} parts {order, saver, suggester, prefetch, objects, editors, image, page, hint, show}. */
export function createFrames(app, work, parts) {
  const { order, saver, suggester, prefetch, objects, editors, image, page, hint, show } = parts;

  let is_first = true;

  async function openRoute(route) {
    prefetch.stop();
    try {
      const frame = route.frame ?? (await order.next());
      if (frame === null) {
        app.toast("There is no frame left to label.", "warn");
        return;
      }
      if (route.frame === null) {
        history.replaceState(null, "", makeHash(route.project, "label", frame));
        app.state.set({ route: { ...route, frame } });
      }
      await saver.idle();
      // what another mode has left in app.state may be old
      if (is_first || app.state.frame?.frame.id !== frame) await app.loadFrame(frame);
      else onFrame(app.state.frame);
      is_first = false;
    } catch (error) {
      hint.textContent = error.message;
      app.toast(error);
    }
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

  /** Others have saved: read it, unless something of one's own is under way, which brings it along. */
  function onOthersChange({ frame, revision }) {
    const known = app.state.frame?.frame;
    if (known && frame === known.id && revision > known.revision) void refresh();
  }

  async function refresh() {
    const id = app.state.frame?.frame.id;
    if (id === undefined || saver.isBusy) return;
    const state = await app.api.get(app.path("frames", id));
    if (work.draft?.is_loading || editors.some((editor) => editor.isDragging)) {
      setTimeout(refresh, BUSY_WAIT_MS);
      return;
    }
    if (!saver.isBusy && app.state.frame?.frame.id === id && state.frame.revision >= app.state.frame.frame.revision) app.state.set({ frame: state });
  }

  async function go(direction) {
    prefetch.stop();
    await flush();
    if (saver.isBusy) {
      app.toast("The last change is not saved yet: try that again first.", "warn");
      return;
    }
    const frame = direction === "next" ? await order.next() : order.previous();
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

  return { openRoute, onFrame, onSaved, onOthersChange, refresh, go, setOrder, flush };
}
