/**
 * The 2D editor: boxes over a picture. One component for the camera image, the pseudo-views and the orthogonal views.
 *
 *   const editor = createEditor(host, options)
 *
 * options (all optional):
 *   onChange(boxes, why, index, actions)  after each finished change; why: draw move resize nudge delete class accept.
 *                                         `actions` says how many key presses or drags it took (nudges come together).
 *   onDrag(boxes, index)                  while dragging, for previews; no change yet
 *   onSelect(index)                       -1: none
 *   onRotate(angle_rad, final)            from the rotation handle; a positive angle turns the view's x towards its y. The
 *                                         editor shows the turn until the next setBoxes
 *   onOverlay(id)                         a click within the outline of an overlay that has an id, and in no box
 *   classes: [names], color(box)          colours; by default the class's
 *   newLabel()                            class of a drawn box, by default the first one
 *   selectFirst                           only the selected box can be resized: a drag from the edge of another one draws
 *   single, canDraw, canMove, canDelete   one box only: drawing replaces it · by default all true but single; canDraw may be
 *                                         a function that is asked each time
 *   clip                                  boxes end at the picture's border (default true)
 *   label                                 accessible name
 *
 * A box is {label, x_min, y_min, x_max, y_max, …}: continuous px, the first pixel's centre is (0, 0). Further properties are
 * kept: `suggested` (dashed; a click or accept() makes it the operator's, a drag corrects it), `readonly`, `faint`, `caption`
 * (text in place of the label). An overlay is {polyline | segments, color, dash, strong, width, id, tag}, in the same px;
 * `tag` is a short text at its top corner.
 */

import { classColor } from "../colors.js";
import { h, iconButton, s } from "../dom.js";
import { drawScene } from "./draw.js";
import { heightOf, moved, pictureLimits, resized, widthOf } from "./geometry.js";
import { listenToPointers } from "./pointers.js";
import { createView } from "./view.js";

const NUDGES_END_MS = 500;
const ZOOM_STEP = 1.4;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export function createEditor(host, options = {}) {
  const image = h("img", { class: "picture", alt: "", draggable: "false" });
  const svg = s("svg", { class: "shapes", "aria-hidden": "true" });
  const spoken = h("span", { class: "visually-hidden", "aria-live": "polite" });
  const readout = h("span", { class: "readout number", "aria-hidden": "true" });
  const zoom_text = h("span", { class: "number" });
  const root = h(
    "div",
    { class: "editor2d", tabindex: 0, role: "application", "aria-roledescription": "box editor", "aria-label": options.label ?? "Picture with boxes", "data-testid": "editor2d" },
    image,
    svg,
    readout,
    h("div", { class: "zoom-bar" }, zoom_text, iconButton("fit", "Fit the picture (0)", () => editor.fit(), { tabindex: -1 })),
    spoken,
  );
  const view = createView();
  let boxes = [];
  let selected = -1;
  let overlays = [];
  let handles = { edges: true, corners: true, rotate: false };
  let is_readonly = false;
  let cross = null;
  let turn_rad = 0;
  let drawn = 0;
  let shown_url = null;
  let nudged = { index: -1, actions: 0, timer: 0 };
  const picture = { width: 0, height: 0 };
  /** Of the window, CSS pixels and fractions of them; `border` is its outer width. */
  const size = { width: 0, height: 0, border: 0 };

  function redraw() {
    drawn ||= requestAnimationFrame(draw);
  }

  function draw() {
    drawn = 0;
    image.style.width = `${picture.width}px`;
    image.style.height = `${picture.height}px`;
    image.style.transform = `translate(${view.offset[0]}px, ${view.offset[1]}px) scale(${view.scale})`;
    // Magnified pixels are shown as what they are, so that an edge can be set on one.
    image.classList.toggle("crisp", view.scale * devicePixelRatio > 1.5);
    svg.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    drawScene(svg, { view, size, boxes, selected, overlays, handles, is_readonly, cross, turn_rad, colorOf });
    zoom_text.textContent = `${Math.round(view.scale * 100)} %`;
  }

  const colorOf = (box) => box.color ?? options.color?.(box) ?? classColor(options.classes ?? [], box.label);
  const clone = () => boxes.map((box) => ({ ...box }));

  function say(text) {
    spoken.textContent = text;
  }

  function describe(box) {
    const [x, y, width, height] = [box.x_min, box.y_min, widthOf(box), heightOf(box)].map((value) => value.toFixed(1));
    return `${box.suggested ? "suggested " : ""}${box.label ?? "box"}, ${width} by ${height} pixels at ${x}, ${y}`;
  }

  /** What the gestures work on. */
  const inner = {
    root,
    view,
    picture,
    size,
    options,
    get boxes() {
      return boxes;
    },
    get selected() {
      return selected;
    },
    get overlays() {
      return overlays;
    },
    get handles() {
      return handles;
    },
    redraw,
    flush,
    isReadonly: () => is_readonly,
    canDraw: () => (typeof options.canDraw === "function" ? options.canDraw() : options.canDraw !== false) && !is_readonly && picture.width > 0,
    limits: () => pictureLimits(picture, options.clip !== false),
    newBox: () => ({ label: options.newLabel?.() ?? options.classes?.[0] ?? "" }),
    select: selectBox,
    setCross(point, px) {
      cross = point;
      readout.textContent = px && point ? `${px[0].toFixed(1)}, ${px[1].toFixed(1)}` : "";
      redraw();
    },
    restore(before) {
      boxes = before.boxes;
      selected = before.selected;
      redraw();
      options.onDrag?.(clone(), selected);
    },
    replace(list, index) {
      boxes = list;
      selected = index;
      redraw();
      options.onDrag?.(clone(), index);
    },
    put(index, box) {
      boxes = boxes.with(index, box);
      redraw();
      options.onDrag?.(clone(), index);
    },
    commit(why, index) {
      if (why === "draw") options.onSelect?.(index);
      say(describe(boxes[index]));
      redraw();
      options.onChange?.(clone(), why, index, 1);
    },
    turn(angle_rad, is_final) {
      turn_rad = angle_rad;
      redraw();
      options.onRotate?.(angle_rad, is_final);
    },
    accept,
  };

  function accept(index) {
    boxes = boxes.with(index, { ...boxes[index], suggested: false });
    inner.commit("accept", index);
  }

  function selectBox(index) {
    if (index !== selected) flush();
    const known = boxes[index] ? index : -1;
    const is_new = known !== selected;
    selected = known;
    redraw();
    if (!is_new) return;
    if (known >= 0) say(describe(boxes[known]));
    options.onSelect?.(known);
  }

  /** Keys of the focused editor; true where the key was its own. The mode's key table calls it too. */
  function onKey(event) {
    if (event.key === "Escape") return editor.cancel();
    if (event.key === "Insert") return newBoxInTheMiddle();
    if (event.key === "0" && !event.ctrlKey) return editor.fit() ?? true;
    if (event.key === "Delete" || event.key === "Backspace") return editor.deleteSelected();
    if (event.key === "Enter") return editor.acceptSuggestion();
    const arrow = ARROWS[event.key];
    if (!arrow || event.ctrlKey || event.metaKey || is_readonly || !boxes[selected] || boxes[selected].readonly) return false;
    const step = event.shiftKey ? 10 : 1;
    nudge(arrow[0] * step, arrow[1] * step, event.altKey);
    return true;
  }

  function nudge(dx, dy, is_size) {
    const box = boxes[selected];
    const limits = inner.limits();
    const changed = is_size ? resized(box, dx === 0 ? 0 : 1, dy === 0 ? 0 : 1, dx, dy, limits) : moved(box, dx, dy, limits);
    inner.put(selected, { ...changed, suggested: false });
    clearTimeout(nudged.timer);
    nudged = { index: selected, actions: nudged.actions + 1, timer: setTimeout(flush, NUDGES_END_MS) };
  }

  /** Presses that follow each other quickly are one change. */
  function flush() {
    const { index, actions, timer } = nudged;
    if (actions === 0) return;
    clearTimeout(timer);
    nudged = { index: -1, actions: 0, timer: 0 };
    say(describe(boxes[index]));
    options.onChange?.(clone(), "nudge", index, actions);
  }

  function newBoxInTheMiddle() {
    if (!inner.canDraw()) return false;
    flush();
    const [x, y] = view.toPicture([size.width / 2, size.height / 2]);
    const [dx, dy] = [size.width / view.scale / 8, size.height / view.scale / 8];
    const box = { ...inner.newBox(), x_min: x - dx, y_min: y - dy, x_max: x + dx, y_max: y + dy };
    boxes = options.single ? [box] : [...boxes, box];
    selected = boxes.length - 1;
    inner.commit("draw", selected);
    return true;
  }

  const pointers = listenToPointers(inner);
  root.addEventListener("keydown", (event) => {
    if (event.target === root && !event.defaultPrevented && onKey(event)) {
      event.preventDefault();
      event.stopPropagation();
    }
  });
  root.addEventListener("blur", flush);
  /** The first size, before the observer has told it: pictures are fitted into it at once. */
  function measure() {
    const { width, height } = root.getBoundingClientRect();
    Object.assign(size, { width, height, border: width });
  }

  const watcher = new ResizeObserver(([{ contentBoxSize, borderBoxSize }]) => {
    const before = { ...size };
    Object.assign(size, { width: contentBoxSize[0].inlineSize, height: contentBoxSize[0].blockSize, border: borderBoxSize[0].inlineSize });
    if (view.is_fitted) view.fit(picture, size);
    else view.panBy((size.width - before.width) / 2, (size.height - before.height) / 2, picture, size);
    draw();
  });
  host.append(root);
  watcher.observe(root);

  const editor = {
    root,

    /**
     * Shows a picture of width x height px; null shows none. The former one stays until the new one is decoded, and the
     * zoom stays where the size does.
     *
     * @returns {Promise<boolean>} resolves when it is on the screen: false where another picture came in between.
     */
    async setPicture(url, width, height) {
      if (url === shown_url && width === picture.width && height === picture.height) return true;
      shown_url = url;
      const is_same_size = width === picture.width && height === picture.height;
      if (!is_same_size) image.removeAttribute("src");
      picture.width = width ?? 0;
      picture.height = height ?? 0;
      root.classList.toggle("blank", url === null);
      if (!size.width) measure();
      if (!is_same_size || view.is_fitted) view.fit(picture, size);
      draw();
      if (url === null) return true;
      const fresh = new Image();
      fresh.src = url;
      await fresh.decode().catch(() => null);
      if (shown_url !== url) return false;
      image.src = url;
      root.classList.toggle("broken", fresh.naturalWidth === 0);
      return true;
    },

    /** New boxes; a drag that is going on is given up. */
    setBoxes(list, index = -1) {
      pointers.cancel();
      clearTimeout(nudged.timer);
      nudged = { index: -1, actions: 0, timer: 0 };
      boxes = list.map((box) => ({ ...box }));
      selected = boxes[index] ? index : -1;
      turn_rad = 0;
      redraw();
    },
    setOverlays(list) {
      overlays = list;
      redraw();
    },
    setHandles(shown) {
      handles = { ...handles, ...shown };
      redraw();
    },
    setReadonly(value) {
      is_readonly = value;
      root.classList.toggle("readonly", value);
      redraw();
    },
    select: selectBox,
    fit() {
      view.fit(picture, size);
      redraw();
    },
    /** Zooms about the middle of the window. */
    zoom(factor = ZOOM_STEP) {
      view.zoomAbout([size.width / 2, size.height / 2], factor, picture, size);
      redraw();
    },
    deleteSelected() {
      if (selected < 0 || is_readonly || options.canDelete === false || boxes[selected].readonly) return false;
      flush();
      const index = selected;
      boxes = boxes.toSpliced(index, 1);
      selectBox(-1);
      say("deleted");
      options.onChange?.(clone(), "delete", index, 1);
      return true;
    },
    /** Makes the selected suggestion, or the first one, the operator's. */
    acceptSuggestion() {
      const index = boxes[selected]?.suggested ? selected : boxes.findIndex(({ suggested }) => suggested);
      if (index < 0 || is_readonly) return false;
      accept(index);
      return true;
    },
    /** Gives the selected box another class. */
    relabel(label) {
      if (selected < 0 || is_readonly || boxes[selected].label === label) return false;
      flush();
      boxes = boxes.with(selected, { ...boxes[selected], label });
      inner.commit("class", selected);
      return true;
    },
    /** Gives up the drag, or else deselects; false where there was neither. */
    cancel() {
      if (pointers.cancel()) return true;
      if (selected < 0 || options.single) return false;
      selectBox(-1);
      return true;
    },
    key: onKey,
    flush,
    focus: () => root.focus({ preventScroll: true }),
    /** True during a drag, and while key presses are gathered into one change: no time for setBoxes. */
    get isDragging() {
      return pointers.isBusy() || nudged.actions > 0;
    },
    get boxes() {
      return clone();
    },
    get selected() {
      return selected;
    },
    /** {scale, offset: [x, y]}: window = offset + (px + 0.5) * scale, CSS pixels of `root`. */
    get transform() {
      return { scale: view.scale, offset: [...view.offset] };
    },
    destroy() {
      flush();
      pointers.stop();
      watcher.disconnect();
      cancelAnimationFrame(drawn);
      root.remove();
    },
  };
  return editor;
}
