/** The camera image with all boxes of the frame: a click selects, the selected one follows every drag, a new one is drawn. */

import { trackColor } from "../colors.js";
import { h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { imageOverlays } from "./drawing.js";

/** `onDrawn(image_box)`: a box was drawn for a new object; resolves when it is known what became of it. */
export function createImagePanel(host, app, desk, { onDrawn, onMode }) {
  const title = h("h2", { class: "ellipsis" }, "Image");
  const note = h("span", { class: "muted ellipsis", role: "status", "data-testid": "image-note" });
  const with_rejected = h("input", { type: "checkbox", onchange: show, "data-testid": "show-rejected" });
  const by_track = h("input", { type: "checkbox", onchange: colorAnew, "data-testid": "color-by-track" });
  by_track.checked = localStorage.getItem("color-by-track") === "true";
  const body = h("div", { class: "view-body", "data-testid": "review-image" });
  host.append(h("header", {}, title, note, h("span", { class: "grow" }), h("label", { class: "row", title: "One colour an object, not one a state" }, by_track, "tracks"), h("label", { class: "row" }, with_rejected, "rejected")), body);
  /** The class of the box that will be drawn; null where none will be. */
  let wanted = null;
  let is_fitting = false;
  const editor = createEditor(body, {
    label: "Camera image with the frame's boxes",
    classes: app.state.project.classes,
    canDraw: () => wanted !== null && !is_fitting,
    canMove: false,
    canDelete: false,
    newLabel: () => wanted,
    onOverlay: (uid) => desk.select(uid),
    onChange: (boxes, why, index) => why === "draw" && void fit(boxes[index]),
  });
  editor.setHandles({ edges: false, corners: false });

  let known = { image: null, camera: null };

  /** The camera with its picture's size; one object a picture, since what a lens reaches is computed once for each. */
  function cameraOf(image) {
    if (known.image !== image) known = { image, camera: { ...image.camera, width: image.width, height: image.height } };
    return known.camera;
  }

  function colorAnew() {
    localStorage.setItem("color-by-track", String(by_track.checked));
    show();
  }

  const colorOf = (label) => (by_track.checked ? { color: trackColor(label.track_id) } : {});

  function show() {
    const frame = app.state.frame;
    if (!frame) {
      void editor.setPicture(null);
      editor.setOverlays([]);
      note.textContent = "";
      return;
    }
    const { url, width, height } = frame.image;
    const camera = cameraOf(frame.image);
    void editor.setPicture(url, width, height);
    note.textContent = noteOf(frame);
    const selected = desk.shown;
    const others = desk.labels().filter((label) => label.uid !== selected?.uid && (with_rejected.checked || label.state !== "rejected"));
    const overlays = others.flatMap((label) => imageOverlays(camera, label, { selected: false, box: label.is_new || desk.isDraft(label.uid) ? desk.seen(label).box : null, ...colorOf(label) }));
    if (selected) overlays.push(...imageOverlays(camera, selected, { selected: true, box: selected.box, ...colorOf(selected) }));
    editor.setOverlays(overlays);
  }

  function noteOf({ frame }) {
    if (is_fitting) return "Looking for the object in this box …";
    if (wanted !== null) return `Drag a box around a ${wanted}. Esc gives up.`;
    return frame.finalised ? "finalised" : "";
  }

  async function fit(box) {
    const { label, x_min, y_min, x_max, y_max } = box;
    is_fitting = true;
    show();
    try {
      await onDrawn({ label, x_min, y_min, x_max, y_max });
    } finally {
      is_fitting = false;
      draw(null);
    }
  }

  function draw(label) {
    wanted = label;
    editor.setBoxes([]);
    show();
    onMode();
  }

  return {
    show,
    /** From now on a drag draws a box of this class; null: no more. */
    draw,
    /** The class of the box that will be drawn, or null. */
    get drawing() {
      return wanted;
    },
    /** Gives up drawing; false where there is none. */
    cancel() {
      if (wanted === null || is_fitting) return false;
      draw(null);
      return true;
    },
    fit: () => editor.fit(),
    body,
    editor,
    destroy: () => editor.destroy(),
  };
}
