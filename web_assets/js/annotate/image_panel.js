/**
 * The camera image with all boxes of the frame: a click selects a box, and a drag draws a new one. Of the object that
 * is drawn on the pseudo-views, and of those that are not finished, the box on the image is shown, too.
 */

import { classColor, trackColor } from "../colors.js";
import { button, h, patch } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { makeHash } from "../router.js";
import { createLoader } from "../timeline/loader.js";
import { imageOverlay } from "./drawing.js";

/** A shorter drag draws no box, CSS pixels. */
const LEAST_DRAG = 8;

export function createImagePanel(/** @type {Annotate} */ at) {
  const { app, desk } = at;
  const { image: host, hint } = at.parts;
  const title = h("h2.ellipsis", "Image");
  const withRejected = h("input", { type: "checkbox", onchange: show, "data-testid": "show-rejected" });
  const byTrack = h("input", { type: "checkbox", onchange: colorAnew, "data-testid": "color-by-track" });
  byTrack.checked = localStorage.getItem("color-by-track") === "true";
  const body = h("div.view-body", { "data-testid": "image-editor" });
  const cameras = h("div.cameras", {
    role: "toolbar",
    "aria-label": "Cameras of this moment",
    hidden: true,
    "data-testid": "camera-strip",
  });
  host.append(
    h(
      "header",
      title,
      h("span.grow"),
      h("label.row", { title: "Colour boxes by track, not by state" }, byTrack, "tracks"),
      h("label.row", withRejected, "rejected"),
    ),
    body,
    cameras,
  );
  /** The class of the box that was asked for; null: none. @type {string | null} */
  let wanted = null;
  /** The class that was chosen during the drag. @type {string | null} */
  let chosen = null;
  let isDragging = false;
  let isFitting = false;
  let hasLoaded = false;
  let shownFrame = -1;
  const editor = createEditor(body, {
    label: "Camera image with the frame's boxes",
    until: at.until,
    color: ({ label }) => classColor(app.state.project, label),
    canDraw: () => at.commands.canDraw() && !isFitting,
    leastDraw: LEAST_DRAG,
    isAsked: () => wanted !== null,
    // objects are close together, and boxes are drawn one after the other
    selectFirst: true,
    newLabel: () => chosen ?? wanted ?? at.picker.label,
    onDrag: ({ length }, index) => onDrag(length > items.length && index >= items.length),
    onOverlay: (uid) => (uid === "whole" ? at.teach.accept() : desk.select(uid)),
    onSelect(index) {
      if (index < 0) at.teach.release();
      else if (items[index] && !isDashed(index)) at.teach.open(items[index]);
    },
    onChange(boxes, why, index, actions) {
      if (why === "draw" || (isDashed(index) && !at.teach.isOn)) void fit(boxes[index]);
      else at.teach.changeImageBox(items[index], boxes[index], actions);
    },
  });
  /** The objects of the boxes that are shown. @type {Item[]} */
  let items = [];
  let dashed = 0;
  const isDashed = (/** @type {number} */ index) => index >= items.length - dashed && index < items.length;

  const loader = createLoader(() => show());

  function colorAnew() {
    localStorage.setItem("color-by-track", String(byTrack.checked));
    show();
  }

  function show() {
    const frame = app.state.frame;
    if (frame && !hasLoaded && !frame.frame.finalised && desk.labels().length === 0) loadDetectors();
    if (!frame) {
      void editor.setPicture(null);
      editor.setBoxes([]);
      editor.setOverlays([]);
      hint.textContent = "";
      return;
    }
    showCameras(frame);
    const { url, width, height } = frame.image;
    void editor.setPicture(url, width, height);
    hint.textContent = noteOf(frame);
    const shown = desk.labels().filter(({ uid, state }) => {
      return uid === desk.uid || withRejected.checked || state !== "rejected";
    });
    // the selected one over the others
    shown.sort((a, b) => Number(a.uid === desk.uid) - Number(b.uid === desk.uid));
    const overlays = shown.map((label) => {
      return imageOverlay(at, label, byTrack.checked ? trackColor(desk.seen(label).track_id) : undefined);
    });
    editor.setOverlays([...overlays, ...at.teach.overlays()]);
    if (shownFrame !== frame.frame.id) {
      shownFrame = frame.frame.id;
      // ends a drag of the frame that was left
      editor.setBoxes([]);
    }
    if (editor.isDragging) return;
    const { list, selected: index } = at.teach.shown();
    items = list.map(({ item }) => item);
    dashed = list.filter(({ box }) => "suggested" in box).length;
    editor.setReadonly(frame.frame.finalised);
    editor.setBoxes(
      list.map(({ box }) => box),
      index,
    );
  }

  /** Small pictures of all cameras of the moment, if it has several. */
  function showCameras(/** @type {FrameState} */ { frame, image }) {
    const { name: project, recordings } = app.state.project;
    const all = Object.entries(frame.cameras);
    cameras.hidden = all.length < 2;
    if (cameras.hidden) return;
    const version = new URLSearchParams(image.url.split("?")[1]).get("v") ?? "";
    const pictureOf = (/** @type {number} */ id) => `${app.path("frames", id)}/image.jpg?width=160&v=${version}`;
    const isOther = shownFrame !== frame.id;
    if (isOther) loader.rest();
    loader.want(all.map(([, id]) => pictureOf(id)));
    patch(
      cameras,
      all.map(([recording, id]) => {
        const name =
          recordings
            .find((one) => one.id === Number(recording))
            ?.name.split("@")
            .at(-1) ?? "";
        const picture = h("span.picture");
        if (loader.has(pictureOf(id))) picture.style.backgroundImage = `url("${pictureOf(id)}")`;
        return button([picture, h("span.ellipsis", name)], () => app.go(makeHash(project, "annotate", id)), {
          class: "quiet",
          title: name,
          "aria-current": id === frame.id ? "true" : null,
          "data-key": id,
        });
      }),
    );
    if (isOther) cameras.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
  }

  function noteOf(/** @type {FrameState} */ { frame }) {
    if (isFitting) return "Fitting a 3D box …";
    if (wanted !== null) return `Drag a box around a ${wanted}. Press Esc to cancel.`;
    if (frame.finalised) return "finalised";
    const hint = at.teach.hint();
    if (hint) return hint;
    if (desk.shown && desk.shown.better_in !== null)
      return "Another camera sees this object better: double click on it in the list.";
    return desk.labels().length === 0 ? "Drag a box around an object to add it." : "";
  }

  /** For the next drag. A frame without boxes is there to be drawn on. */
  function loadDetectors() {
    hasLoaded = true;
    void app.api.post(app.path("models", "load"));
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
      await at.commands.fitDrawn({ label, x_min, y_min, x_max, y_max });
    } finally {
      isFitting = false;
      draw(null);
    }
  }

  function draw(/** @type {string | null} */ label) {
    if (label !== null && !hasLoaded) loadDetectors();
    wanted = label;
    show();
    at.actions.show();
  }

  return {
    show,
    /** The next drag draws a box of this class; null: none. */
    draw,
    /** Whether a box is being drawn, or fitted to what was drawn. */
    get isBusy() {
      return editor.isDragging || isFitting;
    },
    /** Whether a box was asked for. */
    get isDrawing() {
      return wanted !== null;
    },
    /** Asks for a box of the usual class. */
    drawUsual: () => draw(at.picker.label),
    /** Changes the class of the box that is being drawn or was asked for; false if there is none. */
    setClass(/** @type {string} */ name) {
      if (isDragging) chosen = name;
      else if (wanted !== null) draw(name);
      else return false;
      return true;
    },
    /** Ends drawing; false if nothing was to be drawn. */
    cancel() {
      if (editor.cancel()) return true;
      if (wanted === null || isFitting) return false;
      draw(null);
      return true;
    },
    body,
    editor,
  };
}
