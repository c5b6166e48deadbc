/** Shows Label mode's state in all its panels: image, views, list, bar, hint and 3D view. */

import { cameraOf, imageHeading } from "../camera.js";
import { filledBoxes } from "./draft.js";
import { plainBox, secondAxes } from "./items.js";
import { hintFor } from "./views_pane.js";
import { openGuesses } from "./work.js";

/** @type {Record<string, string>} */
const STATE_COLOR = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5" };
const PREVIEW_COLOR = "#ff5d8f";

export const isFinished = (/** @type {Item} */ item) => Boolean(item.uid) && item.boxes.every(Boolean);

/**
 * @param {ModeApp} app
 * @param {Work} work
 * @param {object} parts
 * @param {Editor} parts.image
 * @param {ViewsPane} parts.views
 * @param {ReturnType<Panel["createClassPicker"]>} parts.picker
 * @param {ReturnType<Panel["createKindSwitch"]>} parts.kinds
 * @param {ReturnType<Panel["createObjectList"]>} parts.list
 * @param {ReturnType<Panel["createFrameBar"]>} parts.bar
 * @param {HTMLElement} parts.hint
 * @param {WholeBoxes} parts.whole
 * @param {ReturnType<typeof import("../attributes.js").createAttributes>} parts.attributes
 * @returns {() => void} shows the current state.
 */
export function createDisplay(app, work, parts) {
  const { image, views, picker, kinds, list, bar, hint, whole, attributes } = parts;
  let sceneShown = "";

  function show() {
    const state = app.state.frame;
    if (!state) {
      showNothing();
      return;
    }
    const { draft, items, label } = work;
    const isReadonly = work.isReadonly;
    image.setReadonly(isReadonly);
    views.setReadonly(isReadonly);
    const guesses = openGuesses(work);
    if (!image.isDragging)
      image.setBoxes(
        [
          ...items.map(imageBox),
          ...guesses.map(({ image_box, caption }) => ({ ...image_box, suggested: true, caption })),
        ],
        work.selected ? items.indexOf(work.selected) : -1,
      );
    image.setOverlays(overlays(state));
    picker.show(draft ? draft.item.image_box.label : label);
    kinds.show(work.kind, isReadonly);
    list.show({ items, current: draft?.item ?? null, state, isReadonly });
    bar.show(state);
    hint.textContent = hintFor({
      draft,
      isReadonly,
      label,
      hasItems: items.length > 0,
      guesses: guesses.length,
      notSaved: work.notSaved.length,
      isWholeOffered: Boolean(whole.offered()),
    });
    views.show(draft);
    attributes.show();
    showScene(state);
  }

  /** No frame is open: none yet, or one that cannot be read. */
  function showNothing() {
    void image.setPicture(null);
    image.setBoxes([]);
    image.setOverlays([]);
    views.show(null);
    picker.show(work.label);
    list.clear();
    bar.clear();
    attributes.show();
    sceneShown = "";
  }

  /**
   * Updates the 3D view once the pseudo-views are there; otherwise the server would draw these twice at the same time.
   */
  function showScene(/** @type {FrameState} */ state) {
    const { draft } = work;
    if (draft && (draft.isLoading || work.coming)) return;
    /** @type {Scene3D} */
    const scene = {
      frame: state.frame.id,
      selected: draft?.item.uid ?? null,
      gizmo: "off",
      draft: sceneDraft(),
    };
    const key = JSON.stringify([scene, state.frame.revision]);
    if (key !== sceneShown) app.viewport.show(scene);
    sceneShown = key;
  }

  function imageBox(/** @type {Item} */ item) {
    return {
      ...item.image_box,
      faint: item !== work.draft?.item,
      caption: item.uid ? `${item.image_box.label} ✓` : item.image_box.label,
    };
  }

  function overlays(/** @type {FrameState} */ state) {
    const { draft } = work;
    const shown = state.labels.filter(({ state: review }) => review !== "rejected");
    /** @type {Overlay[]} */
    const lines = shown.map(({ uid, state: review, outline, box }) => ({
      id: uid,
      segments: outline,
      heading: imageHeading(cameraOf(state.image), box),
      color: STATE_COLOR[review],
      strong: uid === draft?.item.uid,
    }));
    if (draft?.outline && !isFinished(draft.item))
      lines.push({ segments: draft.outline, color: PREVIEW_COLOR, dash: true, strong: true });
    const offered = whole.offered();
    if (offered)
      lines.push({
        segments: offered.outline,
        heading: imageHeading(cameraOf(state.image), offered.box),
        color: PREVIEW_COLOR,
        dash: true,
        strong: true,
        id: "whole",
      });
    return lines.filter(({ segments }) => segments?.length);
  }

  function sceneDraft() {
    if (!work.draft || work.isReadonly) return null;
    const { item, steps } = work.draft;
    const boxes = filledBoxes(work.draft).map((box) => box && plainBox(box));
    const axes = steps[1] ? secondAxes(item) : null;
    return { image_box: plainBox(item.image_box), boxes, axes, box_kind: work.kind };
  }

  return show;
}
