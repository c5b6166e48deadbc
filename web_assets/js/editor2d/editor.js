/**
 * The 2D editor: boxes over a picture, for the camera image, the pseudo-views and the orthogonal views. Its options
 * are `EditorOptions`, its boxes `EditorBox`.
 */

import { h, iconButton, s } from "../dom.js";
import { drawScene } from "./draw.js";
import { createView, heightOf, moved, pictureLimits, resized, widthOf } from "./geometry.js";
import { beginGesture, hitTest } from "./gestures.js";
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
    h(
      "div.zoom-bar",
      zoomText,
      iconButton("fit", "Fit the picture (0)", () => editor.fit(), { tabindex: -1 }),
    ),
    spoken,
  );
  let drawn = 0;
  /** @type {string | null} */
  let shownUrl = null;
  let nudged = { index: -1, actions: 0, timer: 0 };
  const picture = { width: 0, height: 0 };
  const size = { width: 0, height: 0, border: 0 };
  const view = createView(picture, size);

  function draw() {
    drawn = 0;
    // what comes late, as an answer of the server, is not drawn
    if (options.until.aborted) return;
    image.style.width = `${picture.width}px`;
    image.style.height = `${picture.height}px`;
    image.style.transform = `translate(${view.offset[0]}px, ${view.offset[1]}px) scale(${view.scale})`;
    // magnified pixels are not smoothed, so that an edge can be aligned with one
    image.classList.toggle("crisp", view.scale * devicePixelRatio > 1.5);
    svg.setAttribute("viewBox", `0 0 ${size.width} ${size.height}`);
    drawScene(svg, editor);
    zoomText.textContent = `${Math.round(view.scale * 100)} %`;
  }

  function say(/** @type {string} */ text) {
    spoken.textContent = text;
  }

  function describe(/** @type {EditorBox} */ box) {
    const [x, y, width, height] = [box.x_min, box.y_min, widthOf(box), heightOf(box)].map((value) => value.toFixed(1));
    return `${box.suggested ? "suggested " : ""}${box.label || "box"}, ${width} by ${height} pixels at ${x}, ${y}`;
  }

  function forgetNudges() {
    clearTimeout(nudged.timer);
    nudged = { index: -1, actions: 0, timer: 0 };
  }

  /** Arrow keys of the focused editor; true if the key was one of them. Other keys are those of the mode. */
  function onKey(/** @type {KeyboardEvent} */ event) {
    const box = editor.boxes[editor.selected];
    const arrow = ARROWS[event.key];
    if (!arrow || event.ctrlKey || event.metaKey || editor.isReadonly || !box) return false;
    const [dx, dy] = arrow.map((value) => value * (event.shiftKey ? 10 : 1));
    const limits = editor.limits();
    const changed = event.altKey
      ? resized(box, dx === 0 ? 0 : 1, dy === 0 ? 0 : 1, dx, dy, limits)
      : moved(box, dx, dy, limits);
    editor.put(editor.selected, changed);
    clearTimeout(nudged.timer);
    const timer = setTimeout(() => editor.flush(), NUDGES_END_MS);
    nudged = { index: editor.selected, actions: nudged.actions + 1, timer };
    return true;
  }

  /** @type {Editor} */
  const editor = {
    root,
    view,
    size,
    options,
    boxes: [],
    selected: -1,
    overlays: [],
    sight: null,
    isReadonly: false,
    cross: null,
    pulled: null,

    redraw() {
      drawn ||= requestAnimationFrame(draw);
    },
    canDraw: () => (options.canDraw?.() ?? true) && !editor.isReadonly && picture.width > 0,
    limits: () => pictureLimits(picture, options.clip !== false),
    setCross(point, px) {
      editor.cross = point;
      readout.textContent = px && point ? `${px[0].toFixed(1)}, ${px[1].toFixed(1)}` : "";
      editor.redraw();
    },
    show(boxes, selected) {
      Object.assign(editor, { boxes, selected });
      editor.redraw();
      options.onDrag?.(boxes, selected);
    },
    put: (index, box) => editor.show(editor.boxes.with(index, { ...box, suggested: false }), editor.selected),
    commit(why, index, actions = 1) {
      if (why === "draw") options.onSelect?.(index);
      say(describe(editor.boxes[index]));
      editor.redraw();
      options.onChange?.(editor.boxes, why, index, actions);
    },
    pull(handle, by, isFinal) {
      editor.pulled = { handle, by };
      editor.redraw();
      options.onPull?.(handle, by, isFinal);
    },
    select(index) {
      if (index !== editor.selected) editor.flush();
      const known = editor.boxes[index] ? index : -1;
      const isNew = known !== editor.selected;
      editor.selected = known;
      editor.redraw();
      if (!isNew) return;
      if (known >= 0) say(describe(editor.boxes[known]));
      options.onSelect?.(known);
    },

    async setPicture(url, width, height) {
      if (url === shownUrl && width === picture.width && height === picture.height) return true;
      shownUrl = url;
      const isSameSize = width === picture.width && height === picture.height;
      if (!isSameSize) image.removeAttribute("src");
      picture.width = width ?? 0;
      picture.height = height ?? 0;
      root.classList.toggle("blank", url === null);
      if (!size.width) {
        // before the observer reports it, so that pictures are fitted into the window at once
        const { width, height } = root.getBoundingClientRect();
        Object.assign(size, { width, height, border: width });
      }
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
    setBoxes(list, index = -1) {
      pointers.cancel();
      forgetNudges();
      Object.assign(editor, { boxes: list, selected: list[index] ? index : -1, pulled: null });
      editor.redraw();
    },
    setOverlays(overlays, sight = null) {
      Object.assign(editor, { overlays, sight });
      editor.redraw();
    },
    setReadonly(value) {
      editor.isReadonly = value;
      root.classList.toggle("readonly", value);
      editor.redraw();
    },
    fit() {
      view.fit();
      editor.redraw();
    },
    deleteSelected() {
      const index = editor.selected;
      if (index < 0 || editor.isReadonly) return;
      editor.flush();
      editor.boxes = editor.boxes.toSpliced(index, 1);
      editor.select(-1);
      say("deleted");
      options.onChange?.(editor.boxes, "delete", index, 1);
    },
    cancel: () => pointers.cancel(),
    flush() {
      const { index, actions } = nudged;
      forgetNudges();
      if (actions > 0) editor.commit("nudge", index, actions);
    },
    get isDragging() {
      return pointers.isBusy() || nudged.actions > 0;
    },
  };

  const pointers = listenToPointers({
    ...{ root, size, view, until: options.until },
    ...{ redraw: editor.redraw, flush: editor.flush, setCross: editor.setCross, onEnd: options.onEnd },
    hit: (px, event) => hitTest(editor, px, event.pointerType, event.shiftKey),
    begin: (hit, px, point) => beginGesture(editor, hit, px, point),
    isAsked: options.isAsked,
  });
  root.addEventListener("keydown", (event) => {
    if (event.target === root && !event.defaultPrevented && onKey(event)) {
      event.preventDefault();
      event.stopPropagation();
    }
  });
  root.addEventListener("blur", editor.flush);
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
  options.until.addEventListener("abort", () => {
    editor.flush();
    watcher.disconnect();
    cancelAnimationFrame(drawn);
  });
  return editor;
}
