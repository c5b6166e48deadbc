/** Shows what Label mode works on, in all its parts: image, views, list, bar, hint and 3D view. */

import { hintFor, viewsMessage } from "./hints.js";
import { plainBox } from "./items.js";
import { openGuesses } from "./work.js";

const STATE_COLOR = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5" };
const PREVIEW_COLOR = "#ff5d8f";

export const isFinished = (item) => Boolean(item.uid) && item.boxes.every(Boolean);

/** @returns {() => void} show; `parts` are {image, views, picker, kinds, list, bar, hint}. */
export function createDisplay(app, work, parts) {
  const { image, views, picker, kinds, list, bar, hint } = parts;
  let scene_shown = "";

  function show() {
    const state = app.state.frame;
    if (!state) {
      showNothing();
      return;
    }
    const { draft, items, step, label } = work;
    const is_readonly = work.is_readonly;
    image.setReadonly(is_readonly);
    views.setReadonly(is_readonly);
    const guesses = openGuesses(work);
    if (!image.isDragging) image.setBoxes([...items.map(imageBox), ...guesses.map(({ image_box, caption }) => ({ ...image_box, suggested: true, caption }))], items.indexOf(work.selected));
    image.setOverlays(overlays(state));
    picker.show(draft ? draft.item.image_box.label : label);
    kinds.show(work.kind, is_readonly);
    list.show({ items, current: draft?.item ?? null, state, is_readonly });
    bar.show(state);
    hint.textContent = hintFor({ draft, step, is_readonly, label, has_items: items.length > 0, guesses: guesses.length, not_saved: work.not_saved.length });
    views.show(draft, step, viewsMessage(draft, step));
    showScene(state);
  }

  /** No frame is open: none yet, or one that cannot be read. */
  function showNothing() {
    void image.setPicture(null);
    image.setBoxes([]);
    image.setOverlays([]);
    views.show(null, 0, "");
    picker.show(work.label);
    list.clear();
    bar.clear();
    scene_shown = "";
  }

  /** The 3D view follows when the views are there: they come first, and it would draw them once more at the same time. */
  function showScene(state) {
    const { draft, point_size } = work;
    if (draft && (draft.is_loading || work.coming)) return;
    const scene = { frame: state.frame.id, selected: draft?.item.uid ?? null, gizmo: "off", labels: "all", draft: sceneDraft(), point_size };
    const key = JSON.stringify([scene, state.frame.revision]);
    if (key !== scene_shown) app.viewport.show(scene);
    scene_shown = key;
  }

  function imageBox(item) {
    return { ...item.image_box, faint: item !== work.draft?.item, caption: item.uid ? `${item.image_box.label} ✓` : item.image_box.label };
  }

  function overlays(state) {
    const { draft } = work;
    const shown = state.labels.filter(({ state: review }) => review !== "rejected");
    const lines = shown.map(({ uid, state: review, outline }) => ({ id: uid, segments: outline, color: STATE_COLOR[review], strong: uid === draft?.item.uid }));
    if (draft?.outline && !isFinished(draft.item)) lines.push({ segments: draft.outline, color: PREVIEW_COLOR, dash: true });
    return lines.filter(({ segments }) => segments?.length);
  }

  function sceneDraft() {
    if (!work.draft || work.is_readonly) return null;
    const { image_box, boxes } = work.draft.item;
    return { image_box: plainBox(image_box), boxes: boxes.map((box) => box && plainBox(box)) };
  }

  return show;
}
