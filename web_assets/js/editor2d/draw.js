/** Draws boxes, handles, overlays and the crosshair as SVG, in window coordinates, so that lines keep their width. */

import { isDark } from "../colors.js";
import { s } from "../dom.js";
import { heightOf, widthOf } from "./geometry.js";

export const ROTATE_ARM = 26;
const SIGHT_ARM = 20;
/** The arrow of a heading: its length at least, and the lengths between which its head is. */
const ARROW = { least: 14, head: [6, 13] };
/** Seen within about 15 degrees of its direction, an arrow is a ring of this radius: with a dot if it comes nearer. */
const END_ON = { sight: Math.cos((15 * Math.PI) / 180), radius: 6 };

const round = (/** @type {number} */ value) => Math.round(value * 100) / 100;

export function drawScene(/** @type {SVGSVGElement} */ svg, /** @type {Editor} */ scene) {
  /** @type {Element[]} */
  const layers = [...scene.overlays.map((overlay) => drawOverlay(overlay, scene.view)), ...drawTags(scene)];
  scene.boxes.forEach((box, index) => {
    if (index !== scene.selected) layers.push(drawBox(box, index, scene));
  });
  if (scene.cross) layers.push(drawCross(scene.cross, scene.size));
  if (scene.boxes[scene.selected]) layers.push(drawBox(scene.boxes[scene.selected], scene.selected, scene));
  svg.replaceChildren(...layers);
}

/** The box in the window: {x, y, width, height}. */
function windowRect(/** @type {Rect} */ box, /** @type {View} */ view) {
  const [x, y] = view.toWindow([box.x_min, box.y_min]);
  return {
    x: round(x),
    y: round(y),
    width: round(widthOf(box) * view.scale),
    height: round(heightOf(box) * view.scale),
  };
}

function drawBox(/** @type {EditorBox} */ box, /** @type {number} */ index, /** @type {Editor} */ scene) {
  const rect = windowRect(box, scene.view);
  const color = scene.options.color(box);
  const isSelected = index === scene.selected;
  const group = s("g", {
    class: ["box", isSelected && "selected", box.suggested && "suggested", box.faint && "faint"]
      .filter(Boolean)
      .join(" "),
    "data-testid": "editor-box",
    "data-index": index,
  });
  group.append(s("rect.halo", { ...rect }), s("rect.line", { stroke: color, ...rect }));
  if (isSelected) group.append(s("rect.fill", { fill: color, ...rect }));
  const text = box.caption ?? box.label;
  if (text) group.append(...drawCaption(text, rect, color));
  if (isSelected && !scene.isReadonly) group.append(...drawHandles(rect, scene));
  if (isSelected && scene.pulled) {
    const { handle, by } = scene.pulled;
    const shift = (scene.sight ?? [0, 0]).map((px) => round(px * by * scene.view.scale));
    const turn = `rotate(${(by * 180) / Math.PI} ${rect.x + rect.width / 2} ${rect.y + rect.height / 2})`;
    group.setAttribute("transform", handle === "turn" ? turn : `translate(${shift.join(" ")})`);
  }
  return group;
}

function drawCaption(
  /** @type {string} */ text,
  /** @type {{ x: number, y: number }} */ rect,
  /** @type {string} */ color,
) {
  const width = 7.1 * text.length + 8;
  const y = rect.y >= 17 ? rect.y - 16 : rect.y;
  const x = Math.max(rect.x, 0);
  return [
    s("rect.caption", { x, y, width, height: 16, fill: color }),
    s("text", { class: isDark(color) ? "caption on-dark" : "caption", x: x + 4, y: y + 12 }, text),
  ];
}

function drawHandles(
  /** @type {{ x: number, y: number } & Size} */ { x, y, width, height },
  /** @type {Editor} */ { options, sight },
) {
  /** @type {Element[]} */
  const marks = [];
  const mark = (/** @type {number} */ cx, /** @type {number} */ cy) =>
    marks.push(s("rect.handle", { x: round(cx - 3.5), y: round(cy - 3.5), width: 7, height: 7 }));
  const [midX, midY] = [x + width / 2, y + height / 2];
  for (const cx of [x, x + width]) for (const cy of [y, y + height]) mark(cx, cy);
  if (width > 28) for (const cy of [y, y + height]) mark(midX, cy);
  if (height > 28) for (const cx of [x, x + width]) mark(cx, midY);
  if (options.onPull) {
    marks.push(s("line.arm", { x1: midX, y1: y, x2: midX, y2: y - ROTATE_ARM }));
    marks.push(s("circle.handle.rotate", { cx: midX, cy: y - ROTATE_ARM, r: 6, "data-testid": "rotate-handle" }));
  }
  if (sight) {
    const { from, to } = sightArm([midX, midY], width, height, sight);
    marks.push(s("line.arm", { x1: from[0], y1: from[1], x2: to[0], y2: to[1] }));
    marks.push(s("circle.handle.sight", { cx: to[0], cy: to[1], r: 6, "data-testid": "sight-handle" }));
  }
  return marks;
}

/**
 * The arm of the handle that moves a box along the line of sight: from its border to the handle, in the units of `width`.
 *
 * @param {Point} middle
 * @param {number} width
 * @param {number} height
 * @param {Point} sight the direction.
 * @param {number} [unit] a CSS pixel.
 */
export function sightArm([x, y], width, height, [dx, dy], unit = 1) {
  const length = Math.hypot(dx, dy);
  const [ux, uy] = [dx / length, dy / length];
  const border = Math.min(width / 2 / Math.max(Math.abs(ux), 1e-9), height / 2 / Math.max(Math.abs(uy), 1e-9));
  const at = (/** @type {number} */ far) => [x + ux * far, y + uy * far];
  return { from: at(border), to: at(border + SIGHT_ARM * unit) };
}

function drawOverlay(/** @type {Overlay} */ overlay, /** @type {View} */ view) {
  const lines = overlay.segments;
  const d = lines
    .map((line) => line.map((point, i) => `${i ? "L" : "M"}${view.toWindow(point).map(round).join(" ")}`).join(""))
    .join("");
  const group = s("g.overlay", { "data-testid": "editor-overlay", "data-id": overlay.id });
  if (overlay.strong) group.append(s("path.halo", { d }));
  group.append(
    s("path", {
      d,
      stroke: overlay.color,
      "stroke-width": overlay.strong ? 2.2 : 1.4,
      "stroke-dasharray": overlay.dash ? "5 4" : null,
    }),
  );
  if (overlay.heading) group.append(drawHeading(overlay.heading, overlay, view));
  return group;
}

/** Of a heading that cannot be right. */
const WRONG = "#ff5a4f";

/** An arrow that is never too small to be seen. End on, it is a ring with its point (a dot) or its tail (a cross). */
function drawHeading(/** @type {Arrow} */ arrow, /** @type {Overlay} */ overlay, /** @type {View} */ view) {
  const { strong, wrong } = overlay;
  const color = wrong ? WRONG : overlay.color;
  const [from, end] = [view.toWindow(arrow.from), view.toWindow(arrow.to)];
  const reach = Math.hypot(end[0] - from[0], end[1] - from[1]);
  const group = s("g.heading", { "data-testid": wrong ? "wrong-heading" : "heading" });
  const stroke = (/** @type {string} */ d) => {
    group.append(s("path.halo", { d }), s("path", { d, stroke: color, "stroke-width": strong ? 2.2 : 1.6 }));
  };
  if (reach < 1 || Math.abs(arrow.sight) > END_ON.sight) {
    const [x, y] = end.map(round);
    const r = END_ON.radius;
    const k = round(r * Math.SQRT1_2);
    const ring = `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`;
    group.dataset.end = arrow.sight < 0 ? "nearer" : "farther";
    stroke(
      arrow.sight < 0 ? ring : `${ring}M${x - k} ${y - k}l${2 * k} ${2 * k}M${x - k} ${y + k}l${2 * k} ${-2 * k}`,
    );
    if (arrow.sight < 0) group.append(s("circle.head", { cx: x, cy: y, r: 2.2, fill: color }));
    return group;
  }
  const along = [(end[0] - from[0]) / reach, (end[1] - from[1]) / reach];
  const long = Math.max(reach, ARROW.least);
  const head = Math.min(Math.max(long / 3, ARROW.head[0]), ARROW.head[1]);
  const at = (/** @type {number} */ ahead, /** @type {number} */ aside) =>
    [from[0] + ahead * along[0] - aside * along[1], from[1] + ahead * along[1] + aside * along[0]]
      .map(round)
      .join(" ");
  stroke(`M${at(0, 0)}L${at(long - head, 0)}`);
  const d = `M${at(long, 0)}L${at(long - head, head / 2)}L${at(long - head, -head / 2)}Z`;
  group.append(s("path.head", { d, fill: color }));
  return group;
}

const TAG_HEIGHT = 14;

/** @typedef {{ x: number, y: number, width: number }} Tag */

/**
 * Small texts at the top corners of overlays. A text that would cover another one is moved to the next
 * free place, or left out.
 */
function drawTags(/** @type {Pick<Editor, "overlays" | "view" | "size">} */ { overlays, view, size }) {
  /** @type {Tag[]} */
  const taken = [];
  const tagged = overlays.flatMap((one) => (one.tag && one.segments.length ? [{ ...one, tag: one.tag }] : []));
  // the selected one first, so that it is never left out
  const ordered = [...tagged.filter(({ strong }) => strong), ...tagged.filter(({ strong }) => !strong)];
  return ordered.flatMap((overlay) => {
    const width = 6.1 * overlay.tag.length + 8;
    const place = tagPlaces(overlay, view, size, width).find((one) => !taken.some((other) => areOver(one, other)));
    if (!place) return [];
    taken.push(place);
    const { x, y } = place;
    return s(
      "g",
      { class: overlay.strong ? "tag selected" : "tag", "data-testid": "editor-tag", "data-id": overlay.id },
      s("rect", { x, y, width, height: TAG_HEIGHT, fill: overlay.color }),
      s("text", { x: x + 4, y: y + 10.5 }, overlay.tag),
    );
  });
}

/** Above the top corner, beside it, below the lowest corner; all within the window. */
function tagPlaces(
  /** @type {Overlay} */ { segments },
  /** @type {View} */ view,
  /** @type {Size} */ size,
  /** @type {number} */ width,
) {
  const corners = segments.flat().map((point) => view.toWindow(point));
  const top = corners.reduce((a, b) => (b[1] < a[1] ? b : a));
  const low = corners.reduce((a, b) => (b[1] > a[1] ? b : a));
  const inside = (/** @type {number} */ x, /** @type {number} */ y) => ({
    x: round(Math.min(Math.max(x, 0), Math.max(size.width - width, 0))),
    y: round(Math.min(Math.max(y, 0), Math.max(size.height - TAG_HEIGHT, 0))),
    width,
  });
  return [
    inside(top[0] - 2, top[1] - TAG_HEIGHT - 1),
    inside(top[0] - width - 2, top[1]),
    inside(top[0] + 2, top[1] + 2),
    inside(low[0] - 2, low[1] + 1),
  ];
}

const areOver = (/** @type {Tag} */ a, /** @type {Tag} */ b) =>
  a.x < b.x + b.width && b.x < a.x + a.width && Math.abs(a.y - b.y) < TAG_HEIGHT;

function drawCross(/** @type {Point} */ [x, y], /** @type {Size} */ { width, height }) {
  return s(
    "g.cross",
    s("line", { x1: 0, x2: width, y1: round(y), y2: round(y) }),
    s("line", { x1: round(x), x2: round(x), y1: 0, y2: height }),
  );
}
