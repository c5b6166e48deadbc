/** Pointer events of an editor: one pointer at a time makes a gesture, the middle button or Space pans, two fingers pinch. */

import { beginGesture, cursorOf, hitTest } from "./gestures.js";

export function listenToPointers(editor) {
  const { root, view } = editor;
  const touches = new Map();
  let gesture = null;
  let owner = null;
  let is_space_down = false;
  let last_point = [0, 0];

  /** Where an event is, in CSS pixels of the editor's own box, also where an ancestor is scaled. */
  function windowPoint(event) {
    const rect = root.getBoundingClientRect();
    const stretch = rect.width / (editor.size.border || rect.width) || 1;
    return [(event.clientX - rect.left) / stretch - root.clientLeft, (event.clientY - rect.top) / stretch - root.clientTop];
  }

  function onDown(event) {
    if (event.target.closest("button")) return;
    const point = windowPoint(event);
    if (event.pointerType === "touch") {
      touches.set(event.pointerId, point);
      if (touches.size === 2) beginPinch();
      if (touches.size >= 2) return;
    }
    if (gesture) return;
    const is_pan = event.button === 1 || (event.button === 0 && is_space_down);
    if (!is_pan && event.button !== 0) return;
    event.preventDefault();
    root.focus({ preventScroll: true });
    root.setPointerCapture(event.pointerId);
    owner = event.pointerId;
    editor.flush();
    const px = view.toPicture(point);
    gesture = is_pan ? beginPan(point) : beginGesture(editor, hitTest(editor, px, event.pointerType, event.shiftKey), px, point);
    editor.setCross(null);
  }

  function beginPan(start) {
    let last = start;
    root.classList.add("panning");
    const end = () => root.classList.remove("panning");
    return {
      move(_, point) {
        view.panBy(point[0] - last[0], point[1] - last[1], editor.picture, editor.size);
        last = point;
        editor.redraw();
      },
      finish: end,
      cancel: end,
    };
  }

  /** Two fingers: what was begun with the first one is taken back. */
  function beginPinch() {
    gesture?.cancel();
    let [a, b] = [...touches.values()];
    gesture = {
      move() {
        const [c, d] = [...touches.values()];
        if (!d) return;
        const before = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
        const after = [(c[0] + d[0]) / 2, (c[1] + d[1]) / 2];
        const factor = Math.hypot(c[0] - d[0], c[1] - d[1]) / Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1);
        view.panBy(after[0] - before[0], after[1] - before[1], editor.picture, editor.size);
        view.zoomAbout(after, factor, editor.picture, editor.size);
        [a, b] = [c, d];
        editor.redraw();
      },
      finish() {},
      cancel() {},
    };
    owner = "pinch";
  }

  function onMove(event) {
    const point = windowPoint(event);
    last_point = point;
    if (touches.has(event.pointerId)) touches.set(event.pointerId, point);
    if (gesture && (owner === event.pointerId || (owner === "pinch" && touches.has(event.pointerId)))) gesture.move(view.toPicture(point), point);
    else if (!gesture && event.pointerType !== "touch") hover(event, point);
  }

  function hover(event, point) {
    const px = view.toPicture(point);
    const hit = hitTest(editor, px, event.pointerType, event.shiftKey);
    root.style.cursor = is_space_down ? "grab" : cursorOf(hit);
    editor.setCross(hit.kind === "nothing" || event.target.closest("button") ? null : point, px);
  }

  function onUp(event) {
    touches.delete(event.pointerId);
    if (!gesture || (owner !== event.pointerId && owner !== "pinch")) return;
    if (owner === "pinch" && touches.size > 0) return;
    const point = windowPoint(event);
    const ended = gesture;
    gesture = null;
    owner = null;
    ended.finish(view.toPicture(point), point);
  }

  function cancel() {
    if (!gesture) return false;
    const ended = gesture;
    gesture = null;
    owner = null;
    touches.clear();
    ended.cancel();
    return true;
  }

  function onCancel(event) {
    touches.delete(event.pointerId);
    if (owner === event.pointerId) cancel();
  }

  function onWheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 300 : 1;
    const factor = Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0017));
    // A wheel event comes in whole pixels; the pointer's own place is finer.
    const rough = windowPoint(event);
    const is_there = Math.hypot(rough[0] - last_point[0], rough[1] - last_point[1]) < 2;
    view.zoomAbout(is_there ? last_point : rough, factor, editor.picture, editor.size);
    editor.redraw();
  }

  const onSpace = (event) => {
    if (event.key !== " ") return;
    is_space_down = event.type === "keydown" && root.matches(":hover");
    if (root.matches(":hover") && root.contains(document.activeElement)) event.preventDefault();
  };
  const listeners = [
    [root, "pointerdown", onDown],
    [root, "pointermove", onMove],
    [root, "pointerup", onUp],
    [root, "pointercancel", onCancel],
    [root, "pointerleave", () => editor.setCross(null)],
    [root, "wheel", onWheel, { passive: false }],
    // The middle button would start the browser's own scrolling, and paste on some systems.
    [root, "mousedown", (event) => event.button === 1 && event.preventDefault()],
    [root, "auxclick", (event) => event.preventDefault()],
    [root, "dragstart", (event) => event.preventDefault()],
    [window, "keydown", onSpace],
    [window, "keyup", onSpace],
    [window, "blur", () => cancel()],
  ];
  for (const [target, name, fn, options] of listeners) target.addEventListener(name, fn, options);
  return {
    cancel,
    isBusy: () => gesture !== null,
    stop: () => listeners.forEach(([target, name, fn, options]) => target.removeEventListener(name, fn, options)),
  };
}
