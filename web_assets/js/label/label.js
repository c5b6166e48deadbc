/**
 * Label: an object from nothing in five drags (the paper's Fig. 6). A box on the image gives the front and side view of its
 * frustum; a box on each gives the next step's views; a box on each of these finishes the object. Every drag is saved.
 *
 * This file puts the page together and knows its keys. What it works on is in work.js, what a drag means in objects.js, the way
 * from frame to frame in frames.js, what is shown in display.js; drawing is the editor's (../editor2d), views come through
 * draft.js, suggestions through suggestions.js, saving through saver.js.
 */

import { createEditor } from "../editor2d/editor.js";
import { h } from "../dom.js";
import { finality, kindChange } from "./changes.js";
import { createDisplay } from "./display.js";
import { createAsk, createStepLoader } from "./draft.js";
import { createFrames } from "./frames.js";
import { createObjects } from "./objects.js";
import { createOrder } from "./order.js";
import { createPrefetch } from "./prefetch.js";
import { createSaver } from "./saver.js";
import { createClassPicker, createFrameBar, createKindSwitch, createObjectList, noFrames, reviewHash } from "./side_panel.js";
import { createSuggester } from "./suggestions.js";
import { createViewsPane } from "./views_pane.js";
import { createWork, keepKind } from "./work.js";

const POINT_LIMITS = [0.1, 10];
const DRAG_WAIT_MS = 300;

export function mount(root, app) {
  const { classes } = app.state.project;
  if (app.state.project.frames === 0) {
    root.append(noFrames(app.state.project.name));
    return { unmount: () => {} };
  }
  root.classList.add("fixed");
  const work = createWork(app);
  const order = createOrder(app);
  const ask = createAsk(app, () => work.kind);
  const loader = createStepLoader(ask);
  const suggester = createSuggester(app, { ask, onFound });
  const prefetch = createPrefetch(app, order);
  const saver = createSaver(app, { onSaved: (state) => frames.onSaved(state), onDropped: (change) => objects.onDropped(change), onBusy });

  // -- the page

  const hint = h("p", { class: "hint grow", role: "status", "data-testid": "hint" });
  const problem = h("span", { class: "problem", role: "alert", "data-testid": "save-problem" });
  const image_host = h("div", { class: "image", "data-testid": "image-editor" });
  const picker = createClassPicker(app, (name) => objects.pickClass(name));
  const kinds = createKindSwitch(setKind);
  const views = createViewsPane(app, {
    onBox: (...change) => objects.setViewBox(...change),
    onClear: (...change) => objects.clearViewBox(...change),
    onStep: (step) => objects.showStep(step),
    newLabel: () => work.draft?.item.image_box.label ?? work.label,
  });
  const list = createObjectList(app, { onOpen: (item) => objects.open(item), onDelete: (item) => objects.remove(item), onReview: (uid) => app.go(reviewHash(app, uid)) });
  const bar = createFrameBar(app, order, { onPrevious: () => frames.go("previous"), onNext: () => frames.go("next"), onFinalise: finalise, onOrder: (by) => frames.setOrder(by) });
  const viewport_host = h("div", { class: "viewport-host" }, app.viewport.element);
  const page = h(
    "div",
    { class: "label-mode" },
    h("section", { class: "panel image-panel", "aria-label": "Camera image" }, h("header", {}, picker.root, hint, problem), image_host, h("footer", {}, kinds.root)),
    views.root,
    h("div", { class: "aside" }, h("section", { class: "panel view3d", "aria-label": "3D view" }, viewport_host), list.root, bar.root),
  );
  root.append(page);
  const image = createEditor(image_host, {
    label: "Camera image",
    classes,
    // objects stand close, and one box after the other is drawn
    selectFirst: true,
    newLabel: () => work.label,
    onChange: (...change) => objects.onImageChange(...change),
    onSelect: (index) => objects.onImageSelect(index),
    onOverlay: (uid) => objects.openLabel(uid),
  });
  const editors = [image, ...views.editors];
  const focused = () => editors.find((editor) => editor.root.contains(document.activeElement)) ?? image;

  const show = createDisplay(app, work, { image, views, picker, kinds, list, bar, hint });
  const objects = createObjects(app, work, { saver, loader, suggester, prefetch, image, views, show });
  const frames = createFrames(app, work, { order, saver, suggester, prefetch, objects, editors, image, image_host, page, hint, show });

  const stop = [
    app.state.on("frame", frames.onFrame),
    app.events.on("frame", frames.refresh),
    app.events.on("reconnected", frames.refresh),
    app.viewport.on("select", ({ uid }) => objects.openLabel(uid)),
    app.keys.register({
      "next-frame": () => void frames.go("next"),
      "previous-frame": () => void frames.go("previous"),
      "next-box": () => objects.cycle(1),
      "previous-box": () => objects.cycle(-1),
      class: (event, digit) => classes[digit - 1] && objects.pickClass(classes[digit - 1]),
      delete: () => focused().deleteSelected(),
      cancel,
      finalise,
      "accept-suggestion": acceptNext,
      "box-kind": () => setKind(work.kind === "box" ? "silhouette" : "box"),
      "points-larger": () => zoomPoints(1.25),
      "points-smaller": () => zoomPoints(0.8),
      fit: () => editors.forEach((editor) => editor.fit()),
      nudge: (event) => focused().key(event),
      "nudge-size": (event) => focused().key(event),
      "new-box": (event) => focused().key(event),
    }),
  ];

  // -- what parts tell

  function onBusy(is_saving, error) {
    page.toggleAttribute("data-saving", is_saving);
    problem.replaceChildren();
    if (!is_saving && !error) void frames.refresh();
    if (!error) return;
    problem.append(`Not saved: ${error.message} `, h("button", { type: "button", onclick: () => saver.retry() }, "Try again"));
  }

  /** An editor shows nothing new during a drag. */
  function onFound(draft) {
    if (work.draft !== draft) return;
    show();
    if (views.editors.some((editor) => editor.isDragging)) setTimeout(onFound, DRAG_WAIT_MS, draft);
  }

  // -- commands

  function setKind(name) {
    keepKind(name);
    const known = app.state.frame?.image_boxes;
    if (known?.boxes.length && known.box_kind !== name && !work.is_readonly) saver.save(kindChange(name));
    show();
  }

  function finalise() {
    if (app.state.frame) saver.save(finality(!work.is_readonly));
  }

  function acceptNext() {
    // The object at hand first, whatever has the focus; then the next one on the image.
    const turn = [...views.editors.filter((editor) => editor === focused()), ...views.editors, image];
    return turn.some((editor) => editor.acceptSuggestion());
  }

  function cancel() {
    if (editors.some((editor) => editor.isDragging && editor.cancel()) || image.cancel()) return true;
    if (!work.draft) return false;
    objects.close();
    show();
    return true;
  }

  function zoomPoints(factor) {
    work.point_size = Math.min(Math.max(work.point_size * factor, POINT_LIMITS[0]), POINT_LIMITS[1]);
    show();
  }

  void frames.openRoute(app.state.route);
  return {
    route: (route) => void frames.openRoute(route),
    flush: frames.flush,
    unsaved: frames.unsaved,
    unmount() {
      objects.close();
      prefetch.stop();
      app.events.openFrame(null);
      for (const end of stop) end();
      image.destroy();
      views.destroy();
    },
  };
}
