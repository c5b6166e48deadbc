/** The camera image with all boxes of the frame: a click selects a box, and a drag draws a new one. */

import { valuesText } from "../attributes.js";
import { cameraOf } from "../camera.js";
import { classColor, trackColor } from "../colors.js";
import { h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { imageOverlay } from "./drawing.js";

/** A shorter drag draws no box, CSS pixels. */
const LEAST_DRAG = 8;

/**
 * `onDrawn(box)` is called with a box drawn for a new object; it resolves after the fit, whether it succeeded or not.
 * `canDraw()` says whether the frame can get a new box.
 */
export function createImagePanel(
  /** @type {HTMLElement} */ host,
  /** @type {ModeApp} */ app,
  /** @type {Desk} */ desk,
  /** @type {{ hint: HTMLElement, onDrawn: (box: Box2D) => Promise<void>, onMode: () => void,
   *     canDraw: () => boolean }} */ { hint, onDrawn, onMode, canDraw },
) {
  const title = h("h2", { class: "ellipsis" }, "Image");
  const withRejected = h("input", { type: "checkbox", onchange: show, "data-testid": "show-rejected" });
  const byTrack = h("input", { type: "checkbox", onchange: colorAnew, "data-testid": "color-by-track" });
  byTrack.checked = localStorage.getItem("color-by-track") === "true";
  const body = h("div", { class: "view-body", "data-testid": "review-image" });
  host.append(
    h(
      "header",
      {},
      title,
      h("span", { class: "grow" }),
      h("label", { class: "row", title: "Colour boxes by track, not by state" }, byTrack, "tracks"),
      h("label", { class: "row" }, withRejected, "rejected"),
    ),
    body,
  );
  /**
   * The class of the box that was asked for; null: none.
   *
   * @type {string | null}
   */
  let wanted = null;
  /**
   * The class that was chosen during the drag.
   *
   * @type {string | null}
   */
  let chosen = null;
  let isDragging = false;
  let isFitting = false;
  let hasLoaded = false;
  const editor = createEditor(body, {
    label: "Camera image with the frame's boxes",
    color: ({ label }) => classColor(app.state.project, label),
    canDraw: () => canDraw() && !isFitting,
    leastDraw: LEAST_DRAG,
    isAsked: () => wanted !== null,
    canMove: false,
    canDelete: false,
    newLabel: () => chosen ?? wanted ?? usualClass(),
    onDrag: ({ length }) => onDrag(length > 0),
    onOverlay: (uid) => desk.select(uid),
    onChange: (boxes, why, index) => why === "draw" && void fit(boxes[index]),
  });
  editor.setHandles({ edges: false, corners: false });

  function colorAnew() {
    localStorage.setItem("color-by-track", String(byTrack.checked));
    show();
  }

  const colorOf = (/** @type {PageLabel} */ label) => (byTrack.checked ? { color: trackColor(label.track_id) } : {});

  function show() {
    const frame = app.state.frame;
    if (frame && !hasLoaded && !frame.frame.finalised && desk.labels().length === 0) loadDetectors();
    if (!frame) {
      void editor.setPicture(null);
      editor.setOverlays([]);
      hint.textContent = "";
      return;
    }
    const { url, width, height } = frame.image;
    const camera = cameraOf(frame.image);
    void editor.setPicture(url, width, height);
    hint.textContent = noteOf(frame);
    const selected = desk.shown;
    const others = desk
      .labels()
      .filter((label) => label.uid !== selected?.uid && (withRejected.checked || label.state !== "rejected"));
    const overlays = others.map((label) =>
      imageOverlay(camera, label, {
        selected: false,
        box: label.isNew || desk.isDraft(label.uid) ? desk.seen(label).box : null,
        ...colorOf(label),
      }),
    );
    if (selected) {
      const values = valuesText(app, selected);
      overlays.push(
        imageOverlay(camera, selected, { selected: true, box: selected.box, values, ...colorOf(selected) }),
      );
    }
    editor.setOverlays(overlays);
  }

  function noteOf(/** @type {FrameState} */ { frame }) {
    if (isFitting) return "Fitting a 3D box …";
    if (wanted !== null) return `Drag a box around a ${wanted}. Press Esc to cancel.`;
    if (frame.finalised) return "finalised";
    return desk.labels().length === 0 ? "Drag a box around an object to add it." : "";
  }

  const usualClass = () => desk.shown?.label ?? app.state.project.classes[0];

  /** For the next drag. A frame without boxes is there to be drawn on. */
  function loadDetectors() {
    hasLoaded = true;
    app.api.post(app.path("models", "load")).catch(app.toast);
  }

  function onDrag(/** @type {boolean} */ isNow) {
    if (isNow && !hasLoaded) loadDetectors();
    isDragging = isNow;
    if (!isNow) chosen = null;
  }

  async function fit(/** @type {Box2D} */ box) {
    const { label, x_min, y_min, x_max, y_max } = box;
    isFitting = true;
    onDrag(false);
    show();
    try {
      await onDrawn({ label, x_min, y_min, x_max, y_max });
    } finally {
      isFitting = false;
      draw(null);
    }
  }

  function draw(/** @type {string | null} */ label) {
    if (label !== null && !hasLoaded) loadDetectors();
    wanted = label;
    editor.setBoxes([]);
    show();
    onMode();
  }

  return {
    show,
    /** The next drag draws a box of this class; null: none. */
    draw,
    /** Whether a box was asked for. */
    get isDrawing() {
      return wanted !== null;
    },
    /** Asks for a box of the usual class. */
    drawUsual: () => draw(usualClass()),
    /** Changes the class of the box that is being drawn or was asked for; false if there is none. */
    setClass(/** @type {string} */ name) {
      if (isDragging) chosen = name;
      else if (wanted !== null) draw(name);
      else return false;
      return true;
    },
    /** Ends drawing; false if nothing was to be drawn. */
    cancel() {
      if (wanted === null || isFitting) return false;
      draw(null);
      return true;
    },
    fit: () => editor.fit(),
    body,
    editor,
    destroy: () => editor.destroy(),
  };
}
