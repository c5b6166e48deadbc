/**
 * What a drag does, from pointer down to pointer up; touch with two fingers pans and zooms.
 *
 * The editor gives the pieces (see editor.js); nothing here knows the DOM but the pointer events themselves. A gesture is
 * {move(px, window), finish(px, window), cancel()}; positions are computed from the event at hand, so the stored box ends
 * where the pointer was let go, at sub-pixel precision.
 */

import { area2, clampPoint, edgeNear, edgesBetween, heightOf, hull, isInHull, isInside, moved, resized, widthOf } from "./geometry.js";
import { ROTATE_ARM } from "./draw.js";

const REACH = { mouse: 6, pen: 8, touch: 16 };
/** A shorter drag is a click, CSS pixels. */
const CLICK = 3;

const CURSORS = { "-1,-1": "nwse", "1,1": "nwse", "-1,1": "nesw", "1,-1": "nesw", "-1,0": "ew", "1,0": "ew", "0,-1": "ns", "0,1": "ns" };

/** What lies under a pointer: {kind: rotate | resize | move | draw | nothing, index, side_x, side_y}. */
export function hitTest(editor, px, pointer_type, is_forced = false) {
  const { boxes, selected, view, handles, options } = editor;
  const reach = (REACH[pointer_type] ?? REACH.mouse) / view.scale;
  const draw = { kind: editor.canDraw() ? "draw" : "nothing", index: -1 };
  if (editor.isReadonly()) return { kind: "nothing", index: -1 };
  if (is_forced) return draw;
  const current = boxes[selected];
  if (current && !current.readonly) {
    if (handles.rotate && Math.hypot(px[0] - (current.x_min + current.x_max) / 2, px[1] - (current.y_min - ROTATE_ARM / view.scale)) < 1.8 * reach) return { kind: "rotate", index: selected };
    const near = edgeNear(current, px, reach, handles);
    if (near) return { kind: "resize", index: selected, ...near };
    if (isInside(current, px)) return options.canMove === false ? draw : { kind: "move", index: selected };
  }
  for (let index = boxes.length - 1; index >= 0; index--) {
    if (boxes[index].readonly || options.selectFirst) continue;
    const near = edgeNear(boxes[index], px, reach * 0.7, handles);
    if (near) return { kind: "resize", index, ...near };
  }
  return draw;
}

export function cursorOf(hit) {
  if (hit.kind === "resize") return `${CURSORS[`${hit.side_x},${hit.side_y}`]}-resize`;
  return { move: "move", rotate: "grab", draw: "crosshair", nothing: "default" }[hit.kind];
}

/** The box that a click selects: the smallest one around the point. */
function boxAt(boxes, px) {
  let best = -1;
  boxes.forEach((box, index) => {
    if (isInside(box, px) && (best < 0 || widthOf(box) * heightOf(box) < widthOf(boxes[best]) * heightOf(boxes[best]))) best = index;
  });
  return best;
}

function overlayAt(overlays, px) {
  const hits = overlays
    .filter(({ id }) => id !== undefined)
    .map(({ id, segments, polyline }) => ({ id, outline: hull(segments ? segments.flat() : polyline) }))
    .filter(({ outline }) => isInHull(outline, px));
  hits.sort((a, b) => Math.abs(area2(a.outline)) - Math.abs(area2(b.outline)));
  return hits[0]?.id ?? null;
}

/** Starts what a pointer does at a place. */
export function beginGesture(editor, hit, px, window_point) {
  const makers = { draw: beginDraw, move: beginMove, resize: beginResize, rotate: beginRotate, nothing: beginClick };
  const before = { boxes: editor.boxes.map((box) => ({ ...box })), selected: editor.selected };
  const gesture = makers[hit.kind](editor, hit, px);
  let is_drag = false;
  const moves = (point) => (is_drag ||= Math.hypot(point[0] - window_point[0], point[1] - window_point[1]) >= CLICK);
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

function click(editor, px) {
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

function beginClick() {
  return { move() {}, finish() {} };
}

function beginDraw(editor, hit, start) {
  const a = clampPoint(start, editor.limits());
  const others = editor.options.single ? [] : editor.boxes.slice();
  const index = others.length;
  let box = null;
  return {
    move(here) {
      const edges = edgesBetween(a, clampPoint(here, editor.limits()));
      box = { ...editor.newBox(), ...edges };
      editor.replace([...others, box], index);
    },
    finish() {
      if (widthOf(box) < 1 || heightOf(box) < 1) editor.restore({ boxes: others, selected: -1 });
      else editor.commit("draw", index);
    },
  };
}

function beginMove(editor, { index }, start) {
  const box = editor.boxes[index];
  return {
    move: ([x, y]) => editor.put(index, { ...moved(box, x - start[0], y - start[1], editor.limits()), suggested: false }),
    finish: () => editor.commit("move", index),
  };
}

function beginResize(editor, { index, side_x, side_y }, start) {
  const box = editor.boxes[index];
  editor.select(index);
  return {
    move: ([x, y]) => editor.put(index, { ...resized(box, side_x, side_y, x - start[0], y - start[1], editor.limits()), suggested: false }),
    finish: () => editor.commit("resize", index),
  };
}

function beginRotate(editor, { index }, start) {
  const box = editor.boxes[index];
  const center = [(box.x_min + box.x_max) / 2, (box.y_min + box.y_max) / 2];
  const angleTo = ([x, y]) => Math.atan2(y - center[1], x - center[0]);
  const first = angleTo(start);
  let turn_rad = 0;
  return {
    move(here) {
      const raw = angleTo(here) - first;
      turn_rad = Math.atan2(Math.sin(raw), Math.cos(raw));
      editor.turn(turn_rad, false);
    },
    finish: () => editor.turn(turn_rad, true),
    cancel: () => editor.turn(0, false),
  };
}
