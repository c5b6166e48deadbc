/**
 * Pointer events of an editor, or of a map: one pointer makes a gesture, the middle button or Space pans, two fingers pan and zoom.
 */

import { cursorOf } from "./gestures.js";

export function listenToPointers(/** @type {PointerHost} */ host) {
  const { root, view, size, until: signal } = host;
  /** @type {Map<number, Point>} */
  const touches = new Map();
  /** @type {Gesture | null} */
  let gesture = null;
  /** The pointer that makes the gesture. @type {number | "pinch" | null} */
  let owner = null;
  let isSpaceDown = false;
  /** @type {Point} */
  let lastPoint = [0, 0];

  /** The position of an event in the element's own CSS pixels, even if an ancestor element is scaled. */
  function windowPoint(/** @type {MouseEvent} */ event) {
    const rect = root.getBoundingClientRect();
    const stretch = rect.width / (size.border || rect.width) || 1;
    return [
      (event.clientX - rect.left) / stretch - root.clientLeft,
      (event.clientY - rect.top) / stretch - root.clientTop,
    ];
  }

  function onDown(/** @type {PointerEvent} */ event) {
    if (isOnButton(event)) return;
    const point = windowPoint(event);
    if (event.pointerType === "touch") {
      touches.set(event.pointerId, point);
      if (touches.size === 2) beginPinch();
      if (touches.size >= 2) return;
    }
    if (gesture) return;
    const isPan = event.button === 1 || (event.button === 0 && isSpaceDown);
    if (!isPan && event.button !== 0) return;
    event.preventDefault();
    root.focus({ preventScroll: true });
    root.setPointerCapture(event.pointerId);
    owner = event.pointerId;
    host.flush?.();
    const px = view.toPicture(point);
    gesture = isPan ? beginPan(point) : host.begin(host.hit(px, event), px, point);
    host.setCross?.(null);
  }

  /** @returns {Gesture} */
  function beginPan(/** @type {Point} */ start) {
    let last = start;
    root.classList.add("panning");
    const end = () => root.classList.remove("panning");
    return {
      move(_, point) {
        view.panBy(point[0] - last[0], point[1] - last[1]);
        last = point;
        host.redraw();
      },
      finish: end,
      cancel: end,
    };
  }

  /** Two fingers: cancels what the first one has begun. */
  function beginPinch() {
    gesture?.cancel();
    let [a, b] = [...touches.values()];
    gesture = {
      move() {
        const [c, d] = [...touches.values()];
        if (!c || !d) return;
        const before = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
        const after = [(c[0] + d[0]) / 2, (c[1] + d[1]) / 2];
        const factor = Math.hypot(c[0] - d[0], c[1] - d[1]) / Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1);
        view.panBy(after[0] - before[0], after[1] - before[1]);
        view.zoomAbout(after, factor);
        [a, b] = [c, d];
        host.redraw();
      },
      finish() {},
      cancel() {},
    };
    owner = "pinch";
  }

  function onMove(/** @type {PointerEvent} */ event) {
    const point = windowPoint(event);
    lastPoint = point;
    if (touches.has(event.pointerId)) touches.set(event.pointerId, point);
    if (gesture && (owner === event.pointerId || (owner === "pinch" && touches.has(event.pointerId))))
      gesture.move(view.toPicture(point), point);
    else if (!gesture && event.pointerType !== "touch") hover(event, point);
  }

  function hover(/** @type {PointerEvent} */ event, /** @type {Point} */ point) {
    const px = view.toPicture(point);
    const hit = host.hit(px, event);
    root.style.cursor = isSpaceDown ? "grab" : cursorOf(hit);
    const isBare = hit.kind === "nothing" || isOnButton(event) || host.isAsked?.() === false;
    host.setCross?.(isBare ? null : point, px);
  }

  function onUp(/** @type {PointerEvent} */ event) {
    touches.delete(event.pointerId);
    if (!gesture || (owner !== event.pointerId && owner !== "pinch")) return;
    if (owner === "pinch" && touches.size > 0) return;
    const point = windowPoint(event);
    end((ended) => ended.finish(view.toPicture(point), point));
  }

  function cancel() {
    touches.clear();
    return end((ended) => ended.cancel());
  }

  /** False if there is no gesture. */
  function end(/** @type {(ended: Gesture) => void} */ how) {
    if (!gesture) return false;
    const ended = gesture;
    gesture = null;
    owner = null;
    how(ended);
    host.onEnd?.();
    return true;
  }

  function onCancel(/** @type {PointerEvent} */ event) {
    touches.delete(event.pointerId);
    if (owner === event.pointerId) cancel();
  }

  function onWheel(/** @type {WheelEvent} */ event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 300 : 1;
    const factor = Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0017));
    // a wheel event has whole pixels; the last pointer event is more precise
    const rough = windowPoint(event);
    const isThere = Math.hypot(rough[0] - lastPoint[0], rough[1] - lastPoint[1]) < 2;
    view.zoomAbout(isThere ? lastPoint : rough, factor);
    host.redraw();
  }

  const onSpace = (/** @type {KeyboardEvent} */ event) => {
    if (event.key !== " ") return;
    isSpaceDown = event.type === "keydown" && root.matches(":hover");
    if (root.matches(":hover") && root.contains(document.activeElement)) event.preventDefault();
  };
  root.addEventListener("pointerdown", onDown, { signal });
  root.addEventListener("pointermove", onMove, { signal });
  root.addEventListener("pointerup", onUp, { signal });
  root.addEventListener("pointercancel", onCancel, { signal });
  root.addEventListener("pointerleave", () => host.setCross?.(null), { signal });
  root.addEventListener("wheel", onWheel, { passive: false, signal });
  // the middle button would start the browser's own scrolling, and paste on some systems
  root.addEventListener("mousedown", (event) => event.button === 1 && event.preventDefault(), { signal });
  root.addEventListener("auxclick", (event) => event.preventDefault(), { signal });
  root.addEventListener("dragstart", (event) => event.preventDefault(), { signal });
  window.addEventListener("keydown", onSpace, { signal });
  window.addEventListener("keyup", onSpace, { signal });
  window.addEventListener("blur", cancel, { signal });
  return {
    windowPoint,
    cancel,
    isBusy: () => gesture !== null,
  };
}

const isOnButton = (/** @type {Event} */ { target }) => target instanceof Element && target.closest("button") !== null;
