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
/**
 * The actions of a drag; `cancel` only if it must restore something other than the boxes.
 *
 * @typedef {{ move: (px: Point) => void, finish: () => void, cancel?: () => void }} Drag
 */

/** A drag shorter than this is a click, CSS pixels. */
const CLICK = 3;

/** @type {Record<string, string>} */
const CURSORS = {
  "-1,-1": "nwse",
  "1,1": "nwse",
  "-1,1": "nesw",
  "1,-1": "nesw",
  "-1,0": "ew",
  "1,0": "ew",
  "0,-1": "ns",
  "0,1": "ns",
};

/**
 * What lies under a pointer.
 *
 * @param {EditorInside} editor
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
  if (editor.isReadonly()) return { kind: "nothing", index: -1 };
  if (isForced) return draw;
  const current = boxes[selected];
  if (current) {
    if (
      options.onRotate &&
      Math.hypot(px[0] - (current.x_min + current.x_max) / 2, px[1] - (current.y_min - ROTATE_ARM / view.scale)) <
        1.8 * reach
    )
      return { kind: "rotate", index: selected };
    if (sight) {
      const middle = [(current.x_min + current.x_max) / 2, (current.y_min + current.y_max) / 2];
      const { to } = sightArm(middle, widthOf(current), heightOf(current), sight, 1 / view.scale);
      if (Math.hypot(px[0] - to[0], px[1] - to[1]) < 1.8 * reach) return { kind: "slide", index: selected };
    }
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

export function cursorOf(/** @type {Hit} */ hit) {
  if (hit.kind === "resize") return `${CURSORS[`${hit.sideX},${hit.sideY}`]}-resize`;
  return { move: "move", rotate: "grab", slide: "grab", draw: "crosshair", nothing: "default" }[hit.kind];
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
  /** @type {EditorInside} */ editor,
  /** @type {Hit} */ hit,
  /** @type {Point} */ px,
  /** @type {Point} */ windowPoint,
) {
  /** @type {Record<Hit["kind"], (editor: EditorInside, hit: Hit, px: Point) => Drag>} */
  const makers = {
    draw: beginDraw,
    move: beginMove,
    resize: beginResize,
    rotate: beginRotate,
    slide: beginSlide,
    nothing: beginClick,
  };
  const before = { boxes: editor.boxes.map((box) => ({ ...box })), selected: editor.selected };
  const gesture = makers[hit.kind](editor, hit, px);
  let isDrag = false;
  const moves = (/** @type {Point} */ point) =>
    (isDrag ||= Math.hypot(point[0] - windowPoint[0], point[1] - windowPoint[1]) >= CLICK);
  return {
    move(here, point) {
      if (moves(point)) gesture.move(here);
    },
    finish(here, point) {
      if (!moves(point)) {
        editor.restore(before);
        click(editor, px);
        return;
      }
      gesture.move(here);
      gesture.finish();
    },
    cancel() {
      editor.restore(before);
      gesture.cancel?.();
    },
  };
}

function click(/** @type {EditorInside} */ editor, /** @type {Point} */ px) {
  const index = boxAt(editor.boxes, px);
  if (index >= 0) {
    editor.select(index);
    if (editor.boxes[index].suggested && !editor.isReadonly()) editor.accept(index);
    return;
  }
  const overlay = overlayAt(editor.overlays, px);
  if (overlay !== null && editor.options.onOverlay) editor.options.onOverlay(overlay);
  else if (!editor.options.single) editor.select(-1);
}

/** @returns {Drag} */
function beginClick() {
  return { move() {}, finish() {} };
}

/** @returns {Drag} */
function beginDraw(/** @type {EditorInside} */ editor, /** @type {Hit} */ _hit, /** @type {Point} */ start) {
  const a = clampPoint(start, editor.limits());
  const others = editor.options.single ? [] : editor.boxes.slice();
  const index = others.length;
  /** @type {EditorBox | null} */
  let box = null;
  return {
    move(here) {
      const edges = edgesBetween(a, clampPoint(here, editor.limits()));
      box = { ...editor.newBox(), ...edges };
      editor.replace([...others, box], index);
    },
    finish() {
      const least = Math.max(1, (editor.options.leastDraw ?? 0) / editor.view.scale);
      if (box === null || widthOf(box) < least || heightOf(box) < least)
        editor.restore({ boxes: others, selected: -1 });
      else editor.commit("draw", index);
    },
  };
}

/** @returns {Drag} */
function beginMove(/** @type {EditorInside} */ editor, /** @type {Hit} */ { index }, /** @type {Point} */ start) {
  const box = editor.boxes[index];
  return {
    move: ([x, y]) =>
      editor.put(index, { ...moved(box, x - start[0], y - start[1], editor.limits()), suggested: false }),
    finish: () => editor.commit("move", index),
  };
}

/** @returns {Drag} */
function beginResize(
  /** @type {EditorInside} */ editor,
  /** @type {Hit} */ { index, sideX = 0, sideY = 0 },
  /** @type {Point} */ start,
) {
  const box = editor.boxes[index];
  editor.select(index);
  return {
    move: ([x, y]) =>
      editor.put(index, {
        ...resized(box, sideX, sideY, x - start[0], y - start[1], editor.limits()),
        suggested: false,
      }),
    finish: () => editor.commit("resize", index),
  };
}

/** @returns {Drag} */
function beginRotate(/** @type {EditorInside} */ editor, /** @type {Hit} */ { index }, /** @type {Point} */ start) {
  const box = editor.boxes[index];
  const center = [(box.x_min + box.x_max) / 2, (box.y_min + box.y_max) / 2];
  const angleTo = (/** @type {Point} */ [x, y]) => Math.atan2(y - center[1], x - center[0]);
  const first = angleTo(start);
  let turnRad = 0;
  return {
    move(here) {
      const raw = angleTo(here) - first;
      turnRad = Math.atan2(Math.sin(raw), Math.cos(raw));
      editor.turn(turnRad, false);
    },
    finish: () => editor.turn(turnRad, true),
    cancel: () => editor.turn(0, false),
  };
}

/** Along the line of sight. @returns {Drag} */
function beginSlide(/** @type {EditorInside} */ editor, /** @type {Hit} */ _hit, /** @type {Point} */ start) {
  const [dx, dy] = editor.sight ?? [1, 0];
  let metres = 0;
  return {
    move([x, y]) {
      metres = ((x - start[0]) * dx + (y - start[1]) * dy) / (dx * dx + dy * dy);
      editor.slide(metres, false);
    },
    finish: () => editor.slide(metres, true),
    cancel: () => editor.slide(0, false),
  };
}
