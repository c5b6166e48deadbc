/**
 * Label: a new object from a box on the image. A detector finds its 3D box and suggests a box on each of its four
 * views (dashed). Enter accepts all; if the operator corrects one, the others follow. Without a detector, the operator
 * draws them: a box on the image gives the front and side view of its frustum, a box on each gives the views of the
 * next step, and a box on each of these finishes the object (the paper's Fig. 6). Every drag is saved, and the answer
 * contains the next views and suggestions.
 *
 * This file assembles the page and registers its keys. work.js holds the state, objects.js handles drags, frames.js
 * opens frames, display.js shows the state, the editor (../editor2d) draws boxes, draft.js loads views,
 * suggestions.js loads suggestions and offers whole boxes, and saver.js saves.
 */

import { createAttributes } from "../attributes.js";
import { classColor } from "../colors.js";
import { h, leaveField } from "../dom.js";
import { createEditor } from "../editor2d/editor.js";
import { finality, kindChange, valuesChange } from "./changes.js";
import { createDisplay } from "./display.js";
import { createAsk, createStepLoader } from "./draft.js";
import { createFrames, createOrder, createPrefetch } from "./frames.js";
import { createObjects } from "./objects.js";
import { createSaveProblem, createSaver } from "./saver.js";
import {
  createClassPicker,
  createFrameBar,
  createKindSwitch,
  createObjectList,
  noFrames,
  reviewHash,
} from "./side_panel.js";
import { createViewsPane } from "./views_pane.js";
import { createSuggester, createWholeBoxes } from "./suggestions.js";
import { createWork, keepKind, renameClasses } from "./work.js";

const DRAG_WAIT_MS = 300;

/** @returns {Mounted} */
export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  if (app.state.project.frames === 0) {
    root.append(noFrames(app.state.project.name));
    return { unmount: () => {} };
  }
  root.classList.add("fixed");
  app.api.post(app.path("models", "load")).catch(app.toast);
  const work = createWork(app);
  const order = createOrder(app);
  const ask = createAsk(app, () => work.kind);
  const loader = createStepLoader(ask);
  const suggester = createSuggester(app, { ask, onSuggested });
  const prefetch = createPrefetch(app, order);
  const saver = createSaver(app, {
    onSaved: (state) => frames.onSaved(state),
    onDropped: (change) => objects.onDropped(change),
    onBusy,
  });

  const whole = createWholeBoxes(app, work, { saver, onOffered: () => show() });

  // -- the page

  const hint = h("p", { class: "hint grow", role: "status", "data-testid": "hint" });
  const problem = createSaveProblem(app, saver, { onRelabel: relabel, onDiscard: () => frames.discard() });
  const imageHost = h("div", { class: "image", "data-testid": "image-editor" });
  const picker = createClassPicker(app, (name) => objects.pickClass(name));
  const kinds = createKindSwitch(setKind);
  const views = createViewsPane(app, {
    onBox: (...change) => objects.setViewBox(...change),
    onClear: (...change) => objects.clearViewBox(...change),
    onAcceptAll: acceptNext,
    newLabel: () => work.draft?.item.image_box.label ?? work.label,
  });
  const list = createObjectList(app, {
    onOpen: (item) => objects.open(item),
    onDelete: (item) => objects.remove(item),
    onReview: (uid) => app.go(reviewHash(app, uid)),
  });
  const bar = createFrameBar(order, {
    onPrevious: () => frames.go("previous"),
    onNext: () => frames.go("next"),
    onFinalise: finalise,
    onOrder: (by) => frames.setOrder(by),
  });
  const values = h("fieldset", { class: "panel values", hidden: true, "data-testid": "attributes" });
  const attributes = createAttributes(values, app, {
    shown: () => app.state.frame?.labels.find(({ uid }) => uid === work.draft?.item.uid) ?? null,
    set(uid, changed) {
      app.effort.action();
      saver.save(valuesChange(uid, changed));
    },
    setClass: (name) => objects.pickClass(name),
    isReadonly: () => work.isReadonly,
  });
  const viewportHost = h("div", { class: "viewport-host" }, app.viewport.element);
  const page = h(
    "div",
    { class: "label-mode" },
    h(
      "section",
      { class: "panel image-panel", "aria-label": "Camera image" },
      h("header", {}, picker.root, hint, problem.root),
      imageHost,
      h("footer", {}, kinds.root),
    ),
    views.root,
    h(
      "div",
      { class: "aside" },
      h("section", { class: "panel view3d", "aria-label": "3D view" }, viewportHost),
      list.root,
      values,
      bar.root,
    ),
  );
  root.append(page);
  const image = createEditor(imageHost, {
    label: "Camera image",
    color: ({ label }) => classColor(app.state.project, label),
    // objects are close together, and boxes are drawn one after the other
    selectFirst: true,
    newLabel: () => work.label,
    onChange: (...change) => objects.onImageChange(...change),
    onSelect: (index) => objects.onImageSelect(index),
    onEnter: acceptNext,
    onOverlay: (uid) => objects.openLabel(uid),
  });
  const editors = [image, ...views.editors];
  const focused = () => editors.find((editor) => editor.root.contains(document.activeElement)) ?? image;

  const show = createDisplay(app, work, { image, views, picker, kinds, list, bar, hint, whole, attributes });
  const objects = createObjects(app, work, { saver, loader, suggester, whole, prefetch, image, views, show });
  const frames = createFrames(app, work, {
    order,
    saver,
    suggester,
    whole,
    prefetch,
    objects,
    editors,
    image,
    imageHost,
    page,
    hint,
    show,
  });

  const stop = [
    app.state.on("frame", frames.onFrame),
    app.state.on("project", () => {
      show();
      problem.show();
    }),
    app.events.on("classes", ({ renamed }) => {
      relabel(renamed);
      void frames.refresh();
    }),
    app.events.on("frame", frames.refresh),
    app.events.on("reconnected", frames.refresh),
    app.viewport.on("select", ({ uid }) => objects.openLabel(uid)),
    app.keys.register({
      "next-frame": () => void frames.go("next"),
      "previous-frame": () => void frames.go("previous"),
      "next-box": () => objects.cycle(1),
      "previous-box": () => objects.cycle(-1),
      class: (_, digit) => pickClass(Number(digit)),
      attribute: (_, key) => attributes.press(key),
      delete: () => focused().deleteSelected(),
      cancel,
      finalise,
      "accept-suggestion": acceptNext,
      "box-kind": () => setKind(work.kind === "box" ? "silhouette" : "box"),
      "next-whole-box": () => whole.next(),
      fit() {
        for (const editor of editors) editor.fit();
      },
      nudge: (event) => focused().key(event),
      "nudge-size": (event) => focused().key(event),
      "new-box": (event) => focused().key(event),
    }),
  ];

  // -- callbacks

  function onBusy(/** @type {boolean} */ isSaving) {
    page.toggleAttribute("data-saving", isSaving);
    problem.show();
    if (isSaving) return;
    if (saver.problem) objects.onFailed();
    else void frames.refresh();
  }

  /** @param {Record<string, string>} renamed old name of a class -> new name. */
  function relabel(renamed) {
    renameClasses(work, renamed);
    saver.relabel(renamed);
    show();
  }

  /** Waits for the end of a drag: an editor shows no new boxes during one. */
  function onSuggested(/** @type {Draft} */ draft) {
    if (work.draft !== draft) return;
    show();
    if (views.editors.some((editor) => editor.isDragging)) setTimeout(onSuggested, DRAG_WAIT_MS, draft);
  }

  // -- commands

  function setKind(/** @type {Api.BoxKind} */ name) {
    keepKind(name);
    const known = app.state.frame?.image_boxes;
    if (known?.boxes.length && known.box_kind !== name && !work.isReadonly) saver.save(kindChange(name));
    void objects.askAgain();
    show();
  }

  function pickClass(/** @type {number} */ digit) {
    const name = app.state.project.classes[digit - 1];
    if (name) objects.pickClass(name);
  }

  function finalise() {
    if (app.state.frame) saver.save(finality(!work.isReadonly));
  }

  /**
   * Accepts the object's suggestions, its whole box, or else the next suggestion on the image; false if none. A key
   * that is held down accepts only once.
   *
   * @param {KeyboardEvent} [event]
   */
  function acceptNext(event) {
    return event?.repeat || objects.acceptAll() || whole.confirm() || image.acceptSuggestion();
  }

  function cancel() {
    if (editors.some((editor) => editor.isDragging && editor.cancel()) || image.cancel()) return true;
    if (!work.draft) return false;
    objects.close();
    show();
    return true;
  }

  void frames.openRoute(app.state.route);
  return {
    route: (/** @type {Route} */ route) => void frames.openRoute(route),
    flush() {
      leaveField(values);
      return frames.flush();
    },
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
