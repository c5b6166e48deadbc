/** The camera image with all boxes of the frame; a click selects, the selected one follows every drag. */

import { h } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { imageOverlays } from "./drawing.js";

export function createImagePanel(host, app, desk) {
  const title = h("h2", { class: "ellipsis" }, "Image");
  const note = h("span", { class: "muted ellipsis" });
  const with_rejected = h("input", { type: "checkbox", onchange: show, "data-testid": "show-rejected" });
  const body = h("div", { class: "view-body" });
  host.append(h("header", {}, title, note, h("span", { class: "grow" }), h("label", { class: "row" }, with_rejected, "rejected")), body);
  const editor = createEditor(body, { label: "Camera image with the frame's boxes", canDraw: false, canDelete: false, onOverlay: (uid) => desk.select(uid) });

  let known = { image: null, camera: null };

  /** The camera with its picture's size; one object a picture, since what a lens reaches is computed once for each. */
  function cameraOf(image) {
    if (known.image !== image) known = { image, camera: { ...image.camera, width: image.width, height: image.height } };
    return known.camera;
  }

  function show() {
    const frame = app.state.frame;
    if (!frame) return;
    const { url, width, height } = frame.image;
    const camera = cameraOf(frame.image);
    void editor.setPicture(url, width, height);
    note.textContent = frame.frame.finalised ? "finalised" : "";
    const selected = desk.shown;
    const others = frame.labels.filter((label) => label.uid !== selected?.uid && (with_rejected.checked || label.state !== "rejected"));
    const overlays = others.flatMap((label) => imageOverlays(camera, label, { selected: false, box: desk.isDraft(label.uid) ? desk.seen(label).box : undefined }));
    if (selected) overlays.push(...imageOverlays(camera, selected, { selected: true, box: selected.box }));
    editor.setOverlays(overlays);
  }

  return { show, fit: () => editor.fit(), editor, destroy: () => editor.destroy() };
}
