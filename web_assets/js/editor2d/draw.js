/** Draws boxes, handles, overlays and the crosshair as SVG, in window coordinates, so that lines keep their width. */

import { s } from "../dom.js";
import { heightOf, widthOf } from "./geometry.js";

export const ROTATE_ARM = 26;

const round = (value) => Math.round(value * 100) / 100;

/**
 * @param {object} scene {view, size, boxes, selected, overlays, handles, is_readonly, cross, turn_rad, colorOf}
 */
export function drawScene(svg, scene) {
  const layers = [...scene.overlays.map((overlay) => drawOverlay(overlay, scene.view)), ...drawTags(scene)];
  scene.boxes.forEach((box, index) => {
    if (index !== scene.selected) layers.push(drawBox(box, index, scene));
  });
  if (scene.cross) layers.push(drawCross(scene.cross, scene.size));
  if (scene.boxes[scene.selected]) layers.push(drawBox(scene.boxes[scene.selected], scene.selected, scene));
  svg.replaceChildren(...layers);
}

/** The box in the window: {x, y, width, height}. */
function windowRect(box, view) {
  const [x, y] = view.toWindow([box.x_min, box.y_min]);
  return { x: round(x), y: round(y), width: round(widthOf(box) * view.scale), height: round(heightOf(box) * view.scale) };
}

function drawBox(box, index, scene) {
  const rect = windowRect(box, scene.view);
  const color = scene.colorOf(box);
  const is_selected = index === scene.selected;
  const group = s("g", { class: ["box", is_selected && "selected", box.suggested && "suggested", box.faint && "faint"].filter(Boolean).join(" "), "data-testid": "editor-box", "data-index": index });
  group.append(s("rect", { class: "halo", ...rect }), s("rect", { class: "line", stroke: color, ...rect }));
  if (is_selected) group.append(s("rect", { class: "fill", fill: color, ...rect }));
  const text = box.caption ?? box.label;
  if (text) group.append(...drawCaption(text, rect, color));
  if (is_selected && !scene.is_readonly && !box.readonly) group.append(...drawHandles(rect, scene.handles));
  if (is_selected && scene.turn_rad) {
    const turn_deg = (scene.turn_rad * 180) / Math.PI;
    group.setAttribute("transform", `rotate(${turn_deg} ${rect.x + rect.width / 2} ${rect.y + rect.height / 2})`);
  }
  return group;
}

function drawCaption(text, rect, color) {
  const width = 7.1 * text.length + 8;
  const y = rect.y >= 17 ? rect.y - 16 : rect.y;
  const x = Math.max(rect.x, 0);
  return [s("rect", { class: "caption", x, y, width, height: 16, fill: color }), s("text", { class: "caption", x: x + 4, y: y + 12 }, text)];
}

function drawHandles({ x, y, width, height }, { edges, corners, rotate }) {
  const marks = [];
  const mark = (cx, cy) => marks.push(s("rect", { class: "handle", x: round(cx - 3.5), y: round(cy - 3.5), width: 7, height: 7 }));
  const [mid_x, mid_y] = [x + width / 2, y + height / 2];
  if (corners) for (const cx of [x, x + width]) for (const cy of [y, y + height]) mark(cx, cy);
  if (edges && width > 28) for (const cy of [y, y + height]) mark(mid_x, cy);
  if (edges && height > 28) for (const cx of [x, x + width]) mark(cx, mid_y);
  if (rotate) {
    marks.push(s("line", { class: "arm", x1: mid_x, y1: y, x2: mid_x, y2: y - ROTATE_ARM }));
    marks.push(s("circle", { class: "handle rotate", cx: mid_x, cy: y - ROTATE_ARM, r: 6, "data-testid": "rotate-handle" }));
  }
  return marks;
}

function drawOverlay(overlay, view) {
  const lines = overlay.segments ?? [overlay.polyline];
  const d = lines.map((line) => line.map((point, i) => `${i ? "L" : "M"}${view.toWindow(point).map(round).join(" ")}`).join("")).join("");
  const group = s("g", { class: "overlay", "data-testid": "editor-overlay", "data-id": overlay.id });
  if (overlay.strong) group.append(s("path", { class: "halo", d }));
  group.append(s("path", { d, stroke: overlay.color, "stroke-width": overlay.width ?? (overlay.strong ? 2.2 : 1.4), "stroke-dasharray": overlay.dash ? "5 4" : null }));
  return group;
}

const TAG_HEIGHT = 14;

/** Small texts at the top corners of overlays. One that would lie on another takes the next free place, or is left out. */
function drawTags({ overlays, view, size }) {
  const taken = [];
  const tagged = overlays.filter(({ tag, segments }) => tag && segments?.length);
  // the selected one first: its text is never left out
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
function tagPlaces({ segments }, view, size, width) {
  const corners = segments.flat().map((point) => view.toWindow(point));
  const top = corners.reduce((a, b) => (b[1] < a[1] ? b : a));
  const low = corners.reduce((a, b) => (b[1] > a[1] ? b : a));
  const inside = (x, y) => ({
    x: round(Math.min(Math.max(x, 0), Math.max(size.width - width, 0))),
    y: round(Math.min(Math.max(y, 0), Math.max(size.height - TAG_HEIGHT, 0))),
    width,
  });
  return [inside(top[0] - 2, top[1] - TAG_HEIGHT - 1), inside(top[0] - width - 2, top[1]), inside(top[0] + 2, top[1] + 2), inside(low[0] - 2, low[1] + 1)];
}

const areOver = (a, b) => a.x < b.x + b.width && b.x < a.x + a.width && Math.abs(a.y - b.y) < TAG_HEIGHT;

function drawCross([x, y], { width, height }) {
  return s(
    "g",
    { class: "cross" },
    s("line", { x1: 0, x2: width, y1: round(y), y2: round(y) }),
    s("line", { x1: round(x), x2: round(x), y1: 0, y2: height }),
  );
}
