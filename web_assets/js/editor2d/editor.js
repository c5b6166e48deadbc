/**
 * The 2D editor: boxes over a picture, for the camera image, the pseudo-views and the orthogonal views. Its options
 * are `EditorOptions`, its boxes `EditorBox`.
 */

import { h, iconButton, s } from "../dom.js";
import { drawScene } from "./draw.js";
import { createView, heightOf, moved, pictureLimits, resized, widthOf } from "./geometry.js";
import { listenToPointers } from "./pointers.js";

const NUDGES_END_MS = 500;
/** @type {Record<string, number[]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export function createEditor(/** @type {HTMLElement} */ host, /** @type {EditorOptions} */ options) {
  const image = h("img.picture", { alt: "", draggable: "false" });
  const svg = s("svg.shapes", { "aria-hidden": "true" });
  const spoken = h("span.visually-hidden", { "aria-live": "polite" });
  const readout = h("span.readout.number", { "aria-hidden": "true" });
  const zoomText = h("span.number");
  const root = h(
    "div.editor2d",
    {
      tabindex: 0,
      role: "application",
      "aria-roledescription": "box editor",
      "aria-label": options.label,
      "data-testid": "editor2d",
    },
    image,
    svg,
    readout,
    h("div.zoom-bar", zoomText, iconButton("fit", "Fit the picture (0)", fit, { tabindex: -1 })),
    spoken,
  );
  /** @type {EditorBox[]} */
  let boxes = [];
  let selected = -1;
  /** @type {Overlay[]} */
  let overlays = [];
  /** @type {Point | null} */
  let sight = null;
  let isReadonly = false;
  /** @type {Point | null} */
  let cross = null;
  let turnRad = 0;
  let slideM = 0;
  let drawn = 0;
  /** @type {string | null} */
  let shownUrl = null;
  let nudged = { index: -1, actions: 0, timer: 0 };
  const picture = { width: 0, height: 0 };
  const size = { width: 0, height: 0, border: 0 };
  const view = createView(picture, size);
  /** What comes late, as an answer of the server, is not drawn. */
  let isOver = false;

  function redraw() {
    drawn ||= requestAnimationFrame(draw);
  }

  function draw() {
    drawn = 0;
    if (isOver) return;
    image.style.width = `${picture.width}px`;
    image.style.height = `${picture.height}px`;
    image.style.transform = `translate(${view.offset[0]}px, ${view.offset[1]}px) scale(${view.scale})`;
    // magnified pixels are not smoothed, so that an edge can be aligned with one
    image.classList.toggle("crisp", view.scale * devicePixelRatio > 1.5);
    svg.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    const { color, onRotate } = options;
    const canTurn = onRotate !== undefined;
    drawScene(svg, {
      view,
      size,
      boxes,
      selected,
      overlays,
      canTurn,
      sight,
      isReadonly,
      cross,
      turnRad,
      slideM,
      color,
    });
    zoomText.textContent = `${Math.round(view.scale * 100)} %`;
  }

  const clone = () => boxes.map((box) => ({ ...box }));

  function say(/** @type {string} */ text) {
    spoken.textContent = text;
  }

  function describe(/** @type {EditorBox} */ box) {
    const [x, y, width, height] = [box.x_min, box.y_min, widthOf(box), heightOf(box)].map((value) => value.toFixed(1));
    return `${box.suggested ? "suggested " : ""}${box.label || "box"}, ${width} by ${height} pixels at ${x}, ${y}`;
  }

  function fit() {
    view.fit();
    redraw();
  }

  /** @type {EditorInside} */
  const inner = {
    root,
    view,
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
    get sight() {
      return sight;
    },
    redraw,
    flush,
    isReadonly: () => isReadonly,
    canDraw: () => (options.canDraw?.() ?? true) && !isReadonly && picture.width > 0,
    limits: () => pictureLimits(picture, options.clip !== false),
    newBox: () => ({ label: options.newLabel?.() ?? "" }),
    select: selectBox,
    setCross(/** @type {Point | null} */ point, /** @type {Point} */ px) {
      cross = point;
      readout.textContent = px && point ? `${px[0].toFixed(1)}, ${px[1].toFixed(1)}` : "";
      redraw();
    },
    restore(/** @type {{ boxes: EditorBox[], selected: number }} */ before) {
      boxes = before.boxes;
      selected = before.selected;
      redraw();
      options.onDrag?.(clone(), selected);
    },
    replace(/** @type {EditorBox[]} */ list, /** @type {number} */ index) {
      boxes = list;
      selected = index;
      redraw();
      options.onDrag?.(clone(), index);
    },
    put(/** @type {number} */ index, /** @type {EditorBox} */ box) {
      boxes = boxes.with(index, box);
      redraw();
      options.onDrag?.(clone(), index);
    },
    commit(/** @type {EditKind} */ why, /** @type {number} */ index) {
      if (why === "draw") options.onSelect?.(index);
      say(describe(boxes[index]));
      redraw();
      options.onChange?.(clone(), why, index, 1);
    },
    turn(/** @type {number} */ angleRad, /** @type {boolean} */ isFinal) {
      turnRad = angleRad;
      redraw();
      options.onRotate?.(angleRad, isFinal);
    },
    slide(/** @type {number} */ metres, /** @type {boolean} */ isFinal) {
      slideM = metres;
      redraw();
      options.onSlide?.(metres, isFinal);
    },
    accept(/** @type {number} */ index) {
      boxes = boxes.with(index, { ...boxes[index], suggested: false });
      inner.commit("accept", index);
    },
  };

  function selectBox(/** @type {number} */ index) {
    if (index !== selected) flush();
    const known = boxes[index] ? index : -1;
    const isNew = known !== selected;
    selected = known;
    redraw();
    if (!isNew) return;
    if (known >= 0) say(describe(boxes[known]));
    options.onSelect?.(known);
  }

  /** Handles keys of the focused editor; true if the key was one of them. */
  function onKey(/** @type {KeyboardEvent} */ event) {
    if (event.key === "Escape") return editor.cancel();
    if (event.key === "Insert") return newBoxInTheMiddle();
    if (event.key === "0" && !event.ctrlKey) {
      fit();
      return true;
    }
    if (event.key === "Delete" || event.key === "Backspace") return editor.deleteSelected();
    if (event.key === "Enter") return options.onEnter?.() ?? false;
    const arrow = ARROWS[event.key];
    if (!arrow || event.ctrlKey || event.metaKey || isReadonly || !boxes[selected]) return false;
    const step = event.shiftKey ? 10 : 1;
    nudge(arrow[0] * step, arrow[1] * step, event.altKey);
    return true;
  }

  function nudge(/** @type {number} */ dx, /** @type {number} */ dy, /** @type {boolean} */ isSize) {
    const box = boxes[selected];
    const limits = inner.limits();
    const changed = isSize
      ? resized(box, dx === 0 ? 0 : 1, dy === 0 ? 0 : 1, dx, dy, limits)
      : moved(box, dx, dy, limits);
    inner.put(selected, { ...changed, suggested: false });
    clearTimeout(nudged.timer);
    nudged = { index: selected, actions: nudged.actions + 1, timer: setTimeout(flush, NUDGES_END_MS) };
  }

  /** Several key presses in quick succession count as one change. */
  function flush() {
    const { index, actions, timer } = nudged;
    if (actions === 0) return;
    clearTimeout(timer);
    nudged = { index: -1, actions: 0, timer: 0 };
    say(describe(boxes[index]));
    options.onChange?.(clone(), "nudge", index, actions);
  }

  function newBoxInTheMiddle() {
    if (!inner.canDraw() || options.isAsked?.() === false) return false;
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
  /** The initial size, before the observer reports it, so that pictures are fitted into the window at once. */
  function measure() {
    const { width, height } = root.getBoundingClientRect();
    Object.assign(size, { width, height, border: width });
  }

  const watcher = new ResizeObserver(([{ contentBoxSize, borderBoxSize }]) => {
    const before = { ...size };
    Object.assign(size, {
      width: contentBoxSize[0].inlineSize,
      height: contentBoxSize[0].blockSize,
      border: borderBoxSize[0].inlineSize,
    });
    if (view.isFitted) view.fit();
    else view.panBy((size.width - before.width) / 2, (size.height - before.height) / 2);
    draw();
  });
  host.append(root);
  watcher.observe(root);

  const editor = {
    root,

    /**
     * Shows a picture of width x height px, or none (null). The previous picture stays until the new one is decoded,
     * and the zoom stays if the size does.
     *
     * @param {string | null} url
     * @param {number} [width]
     * @param {number} [height]
     * @returns {Promise<boolean>} resolves when it is on the screen; to false if a later call has replaced it.
     */
    async setPicture(url, width, height) {
      if (url === shownUrl && width === picture.width && height === picture.height) return true;
      shownUrl = url;
      const isSameSize = width === picture.width && height === picture.height;
      if (!isSameSize) image.removeAttribute("src");
      picture.width = width ?? 0;
      picture.height = height ?? 0;
      root.classList.toggle("blank", url === null);
      if (!size.width) measure();
      if (!isSameSize || view.isFitted) view.fit();
      draw();
      if (url === null) return true;
      const fresh = new Image();
      fresh.src = url;
      await fresh.decode().catch(() => null);
      if (shownUrl !== url) return false;
      image.src = url;
      root.classList.toggle("broken", fresh.naturalWidth === 0);
      return true;
    },

    /** New boxes; a drag in progress is cancelled. */
    setBoxes(/** @type {EditorBox[]} */ list, /** @type {number} */ index = -1) {
      pointers.cancel();
      clearTimeout(nudged.timer);
      nudged = { index: -1, actions: 0, timer: 0 };
      boxes = list.map((box) => ({ ...box }));
      selected = boxes[index] ? index : -1;
      turnRad = 0;
      slideM = 0;
      redraw();
    },
    setOverlays(/** @type {Overlay[]} */ list) {
      overlays = list;
      redraw();
    },
    /** The line of sight, px for each metre, along which a handle moves the box; null: there is no handle. */
    setSight(/** @type {Point | null} */ along) {
      sight = along;
      redraw();
    },
    setReadonly(/** @type {boolean} */ value) {
      isReadonly = value;
      root.classList.toggle("readonly", value);
      redraw();
    },
    fit,
    deleteSelected() {
      if (selected < 0 || isReadonly || options.canDelete === false) return false;
      flush();
      const index = selected;
      boxes = boxes.toSpliced(index, 1);
      selectBox(-1);
      say("deleted");
      options.onChange?.(clone(), "delete", index, 1);
      return true;
    },
    /** Cancels the drag, or else deselects; false if there was neither a drag nor a selection. */
    cancel() {
      if (pointers.cancel()) return true;
      if (selected < 0 || options.single) return false;
      selectBox(-1);
      return true;
    },
    key: onKey,
    flush,
    /** True during a drag, and while key presses are collected into one change; setBoxes must not be called then. */
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
      isOver = true;
      root.remove();
    },
  };
  return editor;
}
