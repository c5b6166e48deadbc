// Oriented boxes and their orthogonal views: pure functions that give a new box and never change the old one.
//
// A box is what the server sends: {center: [3], size: [3], rotation: [[3], [3], [3]]}, metres, camera frame, columns of
// `rotation` = the box's x (length), y (width) and z (height) axes. A view is {axes, metres_per_px, origin_m, width,
// height}: a point p lies at px ((axes[0].p - origin_m[0]) / metres_per_px, (axes[1].p - origin_m[1]) / metres_per_px).

import {
  aboutAxis, add, angleBetween, column, dot, fromAngles, fromColumns, length, multiply, orthonormal, scale, subtract,
  toAngles,
} from "./rotation.js";

/** No side of a box gets shorter than this, metres. */
export const MIN_SIZE_M = 0.01;

// in the order --- +-- ++- -+- --+ +-+ +++ -++, as the server has it
const SIGNS = [
  [-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1],
];

/** The 12 edges by the numbers of their corners: bottom, top, uprights. */
export const EDGES = [
  [0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7],
];

/** The box of the server's words, with nothing shared. */
export function copyBox({ center, size, rotation }) {
  return { center: [...center], size: [...size], rotation: rotation.map((row) => [...row]) };
}

/** The box axis `i` as a unit vector in the camera frame. */
export const boxAxis = (box, i) => column(box.rotation, i);

/** The 8 corners, camera frame. */
export function corners(box) {
  const half = [0, 1, 2].map((i) => scale(boxAxis(box, i), box.size[i] / 2));
  return SIGNS.map((sign) => half.reduce((point, side, i) => add(point, scale(side, sign[i])), box.center));
}

/** From the middle of the box to the middle of its front (the +x face) and beyond: which way the heading goes. */
export function headingLine(box) {
  const x = boxAxis(box, 0);
  return [box.center, add(box.center, scale(x, box.size[0] * 0.65))];
}

/** Whether two boxes are the same within a tolerance, metres (of the centre and of the ends that a turn moves). */
export function sameBox(a, b, tolerance_m = 1e-6) {
  const turned = angleBetween(a.rotation, b.rotation) * Math.max(...b.size) / 2;
  const sizes = a.size.map((value, i) => Math.abs(value - b.size[i]));
  return Math.max(length(subtract(a.center, b.center)), turned, ...sizes) <= tolerance_m;
}

// -- on a view

/** Where a point of the camera frame lies on a view, px. */
export function toView(view, point) {
  return [0, 1].map((i) => (dot(view.axes[i], point) - view.origin_m[i]) / view.metres_per_px);
}

/** The rectangle around a box on a view: {x_min, y_min, x_max, y_max}, px. */
export function viewRect(view, box) {
  const spans = [0, 1].map((i) => spanAlong(box, view.axes[i]).map((m) => (m - view.origin_m[i]) / view.metres_per_px));
  return { x_min: spans[0][0], y_min: spans[1][0], x_max: spans[0][1], y_max: spans[1][1] };
}

/** The 12 edges of a box on a view: pairs of px. */
export function viewOutline(view, box) {
  const px = corners(box).map((point) => toView(view, point));
  return EDGES.map(([a, b]) => [px[a], px[b]]);
}

/** From where to where a box reaches along a unit vector, metres. */
export function spanAlong(box, direction) {
  const middle = dot(direction, box.center);
  const half = [0, 1, 2].reduce((sum, i) => sum + (box.size[i] / 2) * Math.abs(dot(direction, boxAxis(box, i))), 0);
  return [middle - half, middle + half];
}

/** The box that reaches from `low` to `high` along a direction: the side most parallel to it takes the change. */
function withSpan(box, direction, low, high) {
  const shares = [0, 1, 2].map((i) => Math.abs(dot(direction, boxAxis(box, i))));
  const k = shares.indexOf(Math.max(...shares));
  const others = [0, 1, 2].reduce((sum, i) => sum + (i === k ? 0 : box.size[i] * shares[i]), 0);
  const size = [...box.size];
  size[k] = Math.max((high - low - others) / shares[k], MIN_SIZE_M);
  const shift = (low + high) / 2 - dot(direction, box.center);
  return { ...box, size, center: add(box.center, scale(direction, shift)) };
}

/**
 * The box after its rectangle on a view has become `rect` (px): what changed along the view's x and y changes the box,
 * its extent along the line of sight stays. An edge that stayed where it was leaves its side of the box where it was.
 */
export function withViewRect(view, box, rect) {
  const before = viewRect(view, box);
  const metres = (px, i) => view.origin_m[i] + px * view.metres_per_px;
  let after = copyBox(box);
  for (const [i, low, high] of [[0, "x_min", "x_max"], [1, "y_min", "y_max"]]) {
    if (rect[low] !== before[low] || rect[high] !== before[high]) {
      after = withSpan(after, view.axes[i], metres(rect[low], i), metres(rect[high], i));
    }
  }
  return after;
}

/** The box turned about its centre and a unit vector of the camera frame. */
export function turned(box, axis, angle_rad) {
  return { ...copyBox(box), rotation: orthonormal(multiply(aboutAxis(axis, angle_rad), box.rotation)) };
}

/** The box after the rotation handle of a view was turned clockwise on the screen (x to y) by an angle. */
export const turnedInView = (view, box, angle_rad) => turned(box, view.axes[2], angle_rad);

/** The same box in space with its heading turned by 90 degrees about its own z: length and width change places. */
export function headingTurned(box) {
  const [x, y, z] = [0, 1, 2].map((i) => boxAxis(box, i));
  return {
    center: [...box.center],
    size: [box.size[1], box.size[0], box.size[2]],
    rotation: fromColumns(y, scale(x, -1), z),
  };
}

// -- as numbers in a form

const DEGREES = 180 / Math.PI;
const tidy = (value) => (Object.is(value, -0) ? 0 : value);

/** {yaw, pitch, roll} in degrees; see `toAngles` for what they mean. */
export function anglesDeg(box, up) {
  const angles = toAngles(box.rotation, up);
  return Object.fromEntries(Object.entries(angles).map(([name, rad]) => [name, tidy(rad * DEGREES)]));
}

/** The box with these angles in degrees. */
export function withAnglesDeg(box, up, { yaw, pitch, roll }) {
  const angles = { yaw: yaw / DEGREES, pitch: pitch / DEGREES, roll: roll / DEGREES };
  return { ...copyBox(box), rotation: fromAngles(angles, up) };
}
