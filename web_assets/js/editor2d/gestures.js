/**
 * The effect of a drag, from pointer down to pointer up (`Gesture`). Positions come from each event, so that a
 * box ends where the pointer was released, with sub-pixel precision.
 */

import {
  area2,
  clampPoint,
  edgeNear,
  edgesBetween,
  heightOf,
  hull,
  isInHull,
  isInside,
  moved,
  resized,
  widthOf,
} from "./geometry.js";
import { ROTATE_ARM, sightArm } from "./draw.js";

/** @type {Record<string, number>} */
const REACH = { mouse: 6, pen: 8, touch: 16 };
/** A drag shorter than this is a click, CSS pixels. */
const CLICK = 3;

/**
 * What lies under a pointer.
 *
 * @param {Editor} editor
 * @param {Point} px
 * @param {string} pointerType
 * @param {boolean} [isForced] draws wherever the pointer is.
 * @returns {Hit}
 */
export function hitTest(editor, px, pointerType, isForced = false) {
  const { boxes, selected, view, sight, options } = editor;
  const reach = (REACH[pointerType] ?? REACH.mouse) / view.scale;
  /** @type {Hit} */
  const draw = { kind: editor.canDraw() ? "draw" : "nothing", index: -1 };
  if (editor.isReadonly) return { kind: "nothing", index: -1 };
  if (isForced) return draw;
  const current = boxes[selected];
  if (current) {
    const middle = [(current.x_min + current.x_max) / 2, (current.y_min + current.y_max) / 2];
    const isAt = (/** @type {Point} */ [x, y]) => Math.hypot(px[0] - x, px[1] - y) < 1.8 * reach;
    if (options.onPull && isAt([middle[0], current.y_min - ROTATE_ARM / view.scale]))
      return { kind: "turn", index: selected };
    const arm = sight && sightArm(middle, widthOf(current), heightOf(current), sight, 1 / view.scale);
    if (arm && isAt(arm.to)) return { kind: "slide", index: selected };
    const near = edgeNear(current, px, reach);
    if (near) return { kind: "resize", index: selected, ...near };
    if (isInside(current, px)) return { kind: "move", index: selected };
  }
  for (let index = boxes.length - 1; index >= 0 && !options.selectFirst; index--) {
    const near = edgeNear(boxes[index], px, reach * 0.7);
    if (near) return { kind: "resize", index, ...near };
  }
  return draw;
}

export function cursorOf(/** @type {Hit} */ { kind, sideX = 0, sideY = 0 }) {
  if (kind !== "resize")
    return { move: "move", turn: "grab", slide: "grab", draw: "crosshair", nothing: "default" }[kind];
  const across = sideX * sideY;
  return `${across > 0 ? "nwse" : across < 0 ? "nesw" : sideX ? "ew" : "ns"}-resize`;
}

/** The box that a click selects: the smallest one around the point. */
function boxAt(/** @type {EditorBox[]} */ boxes, /** @type {Point} */ px) {
  let best = -1;
  boxes.forEach((box, index) => {
    if (isInside(box, px) && (best < 0 || widthOf(box) * heightOf(box) < widthOf(boxes[best]) * heightOf(boxes[best])))
      best = index;
  });
  return best;
}

function overlayAt(/** @type {Overlay[]} */ overlays, /** @type {Point} */ px) {
  const hits = overlays
    .filter(({ id }) => id !== undefined)
    .map(({ id, segments }) => ({ id, outline: hull(segments.flat()) }))
    .filter(({ outline }) => isInHull(outline, px));
  hits.sort((a, b) => Math.abs(area2(a.outline)) - Math.abs(area2(b.outline)));
  return hits[0]?.id ?? null;
}

/** Starts the gesture of a pointer at a point. @returns {Gesture} */
export function beginGesture(
  /** @type {Editor} */ editor,
  /** @type {Hit} */ hit,
  /** @type {Point} */ px,
  /** @type {Point} */ windowPoint,
) {
  /** @type {Record<Hit["kind"], (editor: Editor, hit: Hit, px: Point) => Drag>} */
  const makers = {
    draw: beginDraw,
    move: beginChange,
    resize: beginChange,
    turn: beginTurn,
    slide: beginSlide,
    nothing: () => ({ move() {}, finish() {} }),
  };
  const { boxes, selected } = editor;
  const restore = () => editor.show(boxes, selected);
  const drag = makers[hit.kind](editor, hit, px);
  return dragOrClick(windowPoint, {
    ...drag,
    click() {
      restore();
      click(editor, px);
    },
    cancel() {
      restore();
      drag.cancel?.();
    },
  });
}

/**
 * A gesture that is a drag once the pointer has moved a little, and else a click.
 *
 * @param {Point} start in the window.
 * @param {Drag & { click: () => void, cancel: () => void }} drag
 * @returns {Gesture}
 */
export function dragOrClick(start, { move, finish, click, cancel }) {
  let isDrag = false;
  const moves = (/** @type {Point} */ [x, y]) => (isDrag ||= Math.hypot(x - start[0], y - start[1]) >= CLICK);
  return {
    move(px, point) {
      if (moves(point)) move(px, point);
    },
    finish(px, point) {
      if (!moves(point)) return click();
      move(px, point);
      finish();
    },
    cancel,
  };
}

function click(/** @type {Editor} */ editor, /** @type {Point} */ px) {
  const index = boxAt(editor.boxes, px);
  if (index >= 0) {
    editor.select(index);
    if (!editor.boxes[index].suggested || editor.isReadonly) return;
    editor.boxes = editor.boxes.with(index, { ...editor.boxes[index], suggested: false });
    editor.commit("accept", index);
    return;
  }
  const overlay = overlayAt(editor.overlays, px);
  if (overlay !== null && editor.options.onOverlay) editor.options.onOverlay(overlay);
  else if (!editor.options.single) editor.select(-1);
}

/** @returns {Drag} */
function beginDraw(/** @type {Editor} */ editor, /** @type {Hit} */ _hit, /** @type {Point} */ start) {
  const a = clampPoint(start, editor.limits());
  const others = editor.options.single ? [] : editor.boxes.slice();
  const index = others.length;
  /** @type {EditorBox | null} */
  let box = null;
  return {
    move(here) {
      const edges = edgesBetween(a, clampPoint(here, editor.limits()));
      box = { label: editor.options.newLabel?.() ?? "", ...edges };
      editor.show([...others, box], index);
    },
    finish() {
      const least = Math.max(1, (editor.options.leastDraw ?? 0) / editor.view.scale);
      if (box === null || widthOf(box) < least || heightOf(box) < least) editor.show(others, -1);
      else editor.commit("draw", index);
    },
  };
}

/** Moves a box, or its edges on one side. @returns {Drag} */
function beginChange(
  /** @type {Editor} */ editor,
  /** @type {Hit} */ { kind, index, sideX = 0, sideY = 0 },
  /** @type {Point} */ start,
) {
  const box = editor.boxes[index];
  const why = kind === "move" ? "move" : "resize";
  editor.select(index);
  return {
    move([x, y]) {
      const [dx, dy, limits] = [x - start[0], y - start[1], editor.limits()];
      const changed = why === "move" ? moved(box, dx, dy, limits) : resized(box, sideX, sideY, dx, dy, limits);
      editor.put(index, changed);
    },
    finish: () => editor.commit(why, index),
  };
}

/** @returns {Drag} */
function beginTurn(/** @type {Editor} */ editor, /** @type {Hit} */ { index }, /** @type {Point} */ start) {
  const box = editor.boxes[index];
  const center = [(box.x_min + box.x_max) / 2, (box.y_min + box.y_max) / 2];
  const angleTo = (/** @type {Point} */ [x, y]) => Math.atan2(y - center[1], x - center[0]);
  return pulls(editor, "turn", (here) => {
    const raw = angleTo(here) - angleTo(start);
    return Math.atan2(Math.sin(raw), Math.cos(raw));
  });
}

function beginSlide(/** @type {Editor} */ editor, /** @type {Hit} */ _hit, /** @type {Point} */ start) {
  const [dx, dy] = editor.sight ?? [1, 0];
  return pulls(editor, "slide", ([x, y]) => ((x - start[0]) * dx + (y - start[1]) * dy) / (dx * dx + dy * dy));
}

/** A drag of a handle, which turns or moves the box by an amount. @returns {Drag} */
function pulls(
  /** @type {Editor} */ editor,
  /** @type {PullHandle} */ handle,
  /** @type {(here: Point) => number} */ amount,
) {
  let by = 0;
  return {
    move(here) {
      by = amount(here);
      editor.pull(handle, by, false);
    },
    finish: () => editor.pull(handle, by, true),
    cancel: () => editor.pull(handle, 0, false),
  };
}
