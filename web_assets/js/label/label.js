/**
 * Label: an object from nothing in five drags (the paper's Fig. 6). A box on the image gives the front and side view of its
 * frustum; a box on each gives the next step's views; a box on each of these finishes the object. Every drag is saved.
 *
 * This file knows which object is current and what a drag means; drawing is the editor's (../editor2d), views come through
 * draft.js, saving through saver.js.
 */

import { createEditor } from "../editor2d/editor.js";
import { h } from "../dom.js";
import { makeHash } from "../router.js";
import { createStepLoader, demoteSecondStep, makeDraft } from "./draft.js";
import { hintFor, viewsMessage } from "./hints.js";
import { exchanged, itemsOf, makeItem, openStep, plainBox, overlap, sameBox, sameItem } from "./items.js";
import { createOrder } from "./order.js";
import { createSaver } from "./saver.js";
import { createClassPicker, createFrameBar, createKindSwitch, createObjectList, noFrames, reviewHash } from "./side_panel.js";
import { createViewsPane } from "./views_pane.js";

const STATE_COLOR = { proposed: "#f0ad4e", accepted: "#5fca85", edited: "#6aaef5" };
const PREVIEW_COLOR = "#ff5d8f";
const KIND_KEPT = "box-kind";
const WIDE_ASPECT = 1.9;
/** A box that the detector found is a drawn one already where they overlap by this much (IoU). */
const SAME_OBJECT = 0.4;
const POINT_LIMITS = [0.1, 10];
const SUGGESTION_TRIES = 4;
const SUGGESTION_WAIT_MS = 1500;

export function mount(root, app) {
  const { classes } = app.state.project;
  if (app.state.project.frames === 0) {
    root.append(noFrames(app.state.project.name));
    return { unmount: () => {} };
  }
  root.classList.add("fixed");
  const order = createOrder(app);
  const loader = createStepLoader(app, () => kind());
  const saver = createSaver(app, { onSaved, onDropped, onBusy });
  let items = [];
  let draft = null;
  let step = 0;
  let label = classes[0];
  let not_saved = [];
  let found = [];
  let point_size = 1;
  let frame_shown = null;
  let selected = null;
  let scene_shown = "";
  let loaded = Promise.resolve();
  // The server answers without suggestions while it still loads the detector; asked again, it has them.
  let tries = app.state.project.detectors.view ? SUGGESTION_TRIES : 0;

  // -- the page

  const hint = h("p", { class: "hint grow", role: "status", "data-testid": "hint" });
  const problem = h("span", { class: "problem", role: "alert", "data-testid": "save-problem" });
  const image_host = h("div", { class: "image", "data-testid": "image-editor" });
  const picker = createClassPicker(app, pickClass);
  const kinds = createKindSwitch(setKind);
  const views = createViewsPane(app, { onBox: setViewBox, onClear: clearViewBox, onStep: showStep, newLabel: () => draft?.item.image_box.label ?? label });
  const list = createObjectList(app, { onOpen: open, onDelete: remove, onReview: (uid) => app.go(reviewHash(app, uid)) });
  const bar = createFrameBar(app, order, { onPrevious: () => go("previous"), onNext: () => go("next"), onFinalise: finalise, onOrder: setOrder });
  const viewport_host = h("div", { class: "viewport-host" }, app.viewport.element);
  const page = h(
    "div",
    { class: "label-mode" },
    h("section", { class: "panel image-panel", "aria-label": "Camera image" }, h("header", {}, picker.root, hint, problem), image_host, h("footer", {}, kinds.root)),
    views.root,
    h("div", { class: "aside" }, h("section", { class: "panel view3d", "aria-label": "3D view" }, viewport_host), list.root, bar.root),
  );
  root.append(page);
  const image = createEditor(image_host, { label: "Camera image", classes, newLabel: () => label, onChange: onImageChange, onSelect: onImageSelect, onOverlay: openLabel });
  const editors = [image, ...views.editors];

  const stop = [
    app.state.on("frame", onFrame),
    app.events.on("frame", onOthersChange),
    app.events.on("reconnected", refresh),
    app.viewport.on("select", ({ uid }) => openLabel(uid)),
    app.keys.register({
      "next-frame": () => void go("next"),
      "previous-frame": () => void go("previous"),
      "next-box": () => cycle(1),
      "previous-box": () => cycle(-1),
      class: (event, digit) => classes[digit - 1] && pickClass(classes[digit - 1]),
      delete: () => deleteFocused(),
      cancel: () => cancel(),
      finalise: () => finalise(),
      "accept-suggestion": () => acceptNext(),
      "box-kind": () => setKind(kind() === "box" ? "silhouette" : "box"),
      "points-larger": () => zoomPoints(1.25),
      "points-smaller": () => zoomPoints(0.8),
      fit: () => editors.forEach((editor) => editor.fit()),
      nudge: (event) => focused().key(event),
      "nudge-size": (event) => focused().key(event),
      "new-box": (event) => focused().key(event),
    }),
  ];

  // -- what is shown

  const isReadonly = () => Boolean(app.state.frame?.frame.finalised);
  const kind = () => app.state.frame?.image_boxes?.box_kind ?? localStorage.getItem(KIND_KEPT) ?? "silhouette";
  const focused = () => editors.find((editor) => editor.root.contains(document.activeElement)) ?? image;

  function show() {
    const state = app.state.frame;
    if (!state) return;
    const readonly = isReadonly();
    image.setReadonly(readonly);
    views.setReadonly(readonly);
    const guesses = openGuesses();
    if (!image.isDragging) image.setBoxes([...items.map(imageBox), ...guesses.map(({ image_box, caption }) => ({ ...image_box, suggested: true, caption }))], items.indexOf(selected));
    image.setOverlays(overlays(state));
    picker.show(draft ? draft.item.image_box.label : label);
    kinds.show(kind(), readonly);
    list.show({ items, current: draft?.item ?? null, state, is_readonly: readonly });
    bar.show(state);
    hint.textContent = hintFor({ draft, step, is_readonly: readonly, label, has_items: items.length > 0, guesses: guesses.length, not_saved: not_saved.length });
    views.show(draft, step, viewsMessage(draft, step));
    showScene(state);
  }

  /** The 3D view follows when the views are there: they come first, and it would draw them once more at the same time. */
  function showScene(state) {
    if (draft?.is_loading) return;
    const scene = { frame: state.frame.id, selected: draft?.item.uid ?? null, gizmo: "off", labels: "all", draft: sceneDraft(), point_size };
    const key = JSON.stringify([scene, state.frame.revision]);
    if (key !== scene_shown) app.viewport.show(scene);
    scene_shown = key;
  }

  /** Dashed boxes on the image: what was drawn here and not saved, and what the detector found where nothing is drawn. */
  function openGuesses() {
    if (isReadonly()) return [];
    const mine = not_saved.map((item) => ({ item, image_box: item.image_box, caption: "yours, not saved" }));
    const theirs = found.filter((box) => !items.some((item) => overlap(item.image_box, box) > SAME_OBJECT));
    return [...mine, ...theirs.map((box) => ({ item: makeItem(box), image_box: box, caption: `${box.label} ${Math.round(100 * box.score)} %` }))];
  }

  function imageBox(item) {
    return { ...item.image_box, faint: item !== draft?.item, caption: item.uid ? `${item.image_box.label} ✓` : item.image_box.label };
  }

  function overlays(state) {
    const shown = state.labels.filter(({ state: review }) => review !== "rejected");
    const lines = shown.map(({ uid, state: review, outline }) => ({ id: uid, segments: outline, color: STATE_COLOR[review], strong: uid === draft?.item.uid }));
    if (draft?.outline && !isFinished(draft.item)) lines.push({ segments: draft.outline, color: PREVIEW_COLOR, dash: true });
    return lines.filter(({ segments }) => segments?.length);
  }

  const isFinished = (item) => Boolean(item.uid) && item.boxes.every(Boolean);

  function sceneDraft() {
    if (!draft || isReadonly()) return null;
    const { image_box, boxes } = draft.item;
    return { image_box: plainBox(image_box), boxes: boxes.map((box) => box && plainBox(box)) };
  }

  // -- frames

  async function openRoute(route) {
    try {
      const frame = route.frame ?? (await order.next());
      if (frame === null) {
        app.toast("There is no frame left to label.", "warn");
        return;
      }
      if (route.frame === null) {
        history.replaceState(null, "", makeHash(route.project, "label", frame));
        app.state.set({ route: { ...route, frame } });
      }
      await saver.idle();
      if (app.state.frame?.frame.id !== frame) await app.loadFrame(frame);
      else onFrame(app.state.frame);
    } catch (error) {
      hint.textContent = error.message;
      app.toast(error);
    }
  }

  /** Somebody set the frame's state: a new frame, an undo, another operator. Own savings come through onSaved. */
  function onFrame(state) {
    if (!state) return;
    if (saver.isBusy && frame_shown === state.frame.id) return;
    const is_new = frame_shown !== state.frame.id;
    frame_shown = state.frame.id;
    if (is_new) {
      order.opened(state.frame.id);
      loader.stop();
      draft = null;
      not_saved = [];
      found = [];
      void suggest(state.frame.id);
      const { url, width, height } = state.image;
      page.classList.toggle("wide-image", width / height > WIDE_ASPECT);
      void image.setPicture(url, width, height);
      image.fit();
    }
    rebuild(state);
    if (is_new) app.events.openFrame(state.frame.id);
  }

  /** What the image detector finds, to begin with; without it there is nothing. */
  async function suggest(frame) {
    if (!app.state.project?.detectors.image || isReadonly()) return;
    const { boxes } = await app.api.get(app.path("frames", frame, "label", "suggestions"));
    if (frame_shown !== frame) return;
    found = boxes;
    show();
  }

  function rebuild(state) {
    items = itemsOf(state);
    if (draft) {
      const known = draft.item;
      const index = items.findIndex((item) => sameBox(item.image_box, known.stored) || (item.uid && item.uid === known.uid));
      if (index < 0) draft = null;
      else if (sameItem(items[index], known)) keepCurrent(index);
      else open(items[index]);
    }
    show();
  }

  function keepCurrent(index) {
    draft.item.uid = items[index].uid;
    items[index] = draft.item;
  }

  function onSaved(state) {
    const fresh = itemsOf(state);
    // What is drawn here is newer than any answer; the server adds uids and other people's boxes.
    items = fresh.map((item) => items.find((known) => sameBox(known.stored, item.image_box)) ?? item);
    items.forEach((item, i) => (item.uid = fresh[i].uid ?? null));
    if (draft && !items.includes(draft.item)) draft = null;
    show();
  }

  /** Others have saved: read it, unless something of one's own is under way, which brings it along. */
  function onOthersChange({ frame, revision }) {
    const known = app.state.frame?.frame;
    if (known && frame === known.id && revision > known.revision) void refresh();
  }

  async function refresh() {
    const id = app.state.frame?.frame.id;
    if (id === undefined || saver.isBusy) return;
    const state = await app.api.get(app.path("frames", id));
    if (draft?.is_loading || editors.some((editor) => editor.isDragging)) {
      setTimeout(refresh, 300);
      return;
    }
    if (!saver.isBusy && app.state.frame?.frame.id === id && state.frame.revision >= app.state.frame.frame.revision) app.state.set({ frame: state });
  }

  async function go(direction) {
    await flush();
    const frame = direction === "next" ? await order.next() : order.previous();
    if (frame === null || frame === undefined) app.toast(direction === "next" ? "This is the last frame." : "This is the first frame.", "warn");
    else app.go(makeHash(app.state.route.project, "label", frame));
  }

  function setOrder(value) {
    order.by = value;
    show();
  }

  // -- objects

  /** Makes an object the current one and fetches its views. */
  function open(item) {
    draft = makeDraft(item);
    step = openStep(item);
    label = item.image_box.label;
    loaded = loadSteps();
    show();
  }

  function openLabel(uid) {
    const item = items.find((known) => known.uid === uid);
    if (item) open(item);
  }

  /** @param {Function} [then] what to do with the views at hand, before they are shown. */
  async function loadSteps(then) {
    const loading = draft;
    try {
      const is_newest = await loader.load(loading);
      if (!is_newest || draft !== loading) return;
      then?.();
      if (loading.item.boxes.every(Boolean)) loading.outline = null;
      else askAgain(loading);
    } catch (error) {
      if (draft !== loading) return;
      // What was drawn is saved all the same; the views can be asked for again.
      loading.stop = error.message;
      then?.();
    }
    show();
  }

  function askAgain(loading) {
    if (loading.suggestions.some(Boolean)) tries = 0;
    if (tries <= 0) return;
    tries -= 1;
    setTimeout(() => draft === loading && !loading.is_loading && page.isConnected && void loadSteps(), SUGGESTION_WAIT_MS);
  }

  function showStep(wanted) {
    step = wanted;
    show();
  }

  function onImageSelect(index) {
    const item = items[index];
    selected = item ?? null;
    if (item && item !== draft?.item) open(item);
  }

  function onImageChange(boxes, why, index, actions) {
    app.effort.action(actions);
    if (index >= items.length && why !== "draw") takeGuess(openGuesses()[index - items.length].item, boxes[index]);
    else if (why === "draw") addItem(plainBox(boxes[index]));
    else if (why === "delete") removeItem(items[index]);
    else changeImageBox(items[index], plainBox(boxes[index]));
  }

  function addItem(image_box) {
    const item = makeItem(image_box);
    items = [...items, item];
    selected = item;
    open(item);
    saveObject(item);
  }

  function changeImageBox(item, image_box) {
    item.image_box = image_box;
    const is_drawn = item.boxes.some(Boolean) || item.uid;
    if (draft?.item !== item) {
      draft = makeDraft(item);
      step = openStep(item);
    }
    // Boxes on the views are carried to the new ones first, and saved with them.
    loaded = loadSteps(() => {
      if (is_drawn) saveObject(item);
      step = openStep(item);
    });
    if (!is_drawn) saveObject(item);
    show();
  }

  function setViewBox(index, box, why, actions) {
    app.effort.action(actions);
    const { item } = draft;
    item.boxes[index] = { ...plainBox(box), label: item.image_box.label, score: 1 };
    draft.suggestions[index] = null;
    const is_whole_step = item.boxes[index - (index % 2)] && item.boxes[index - (index % 2) + 1];
    if (index < 2 && is_whole_step) {
      // The second step's views follow from these; what was drawn on the old ones becomes a guess on the new.
      demoteSecondStep(draft);
      loaded = loadSteps(() => (step = 1));
    }
    saveObject(item);
    if (index >= 2 && is_whole_step) image.select(-1);
    show();
  }

  function clearViewBox(index, actions) {
    app.effort.action(actions);
    draft.item.boxes[index] = null;
    if (index < 2) demoteSecondStep(draft);
    saveObject(draft.item);
    step = openStep(draft.item);
    show();
  }

  function pickClass(name) {
    label = name;
    const item = draft?.item;
    if (item && !isReadonly() && (selected === item || !isFinished(item)) && item.image_box.label !== name) {
      app.effort.action();
      item.image_box = { ...item.image_box, label: name };
      item.boxes = item.boxes.map((box) => box && { ...box, label: name });
      saveObject(item);
    }
    show();
  }

  function remove(item) {
    app.effort.action();
    removeItem(item);
  }

  function removeItem(item) {
    items = items.filter((other) => other !== item);
    if (draft?.item === item) {
      loader.stop();
      draft = null;
    }
    const { image_box, uid, stored } = item;
    saver.save({
      path: ["changes"],
      body: (state) => ({
        subject: uid,
        changes: [
          ...(state.labels.some((known) => known.uid === uid) ? [{ kind: "delete", uid }] : []),
          { kind: "image_boxes", boxes: exchanged(state.image_boxes?.boxes ?? [], stored, null), box_kind: kind() },
        ],
      }),
      mine: () => ({ text: [`Deletes the ${image_box.label} in this place`], boxes: [image_box], outlines: [] }),
    });
    show();
  }

  function saveObject(item) {
    const image_box = plainBox(item.image_box);
    const before = item.stored;
    item.stored = image_box;
    const boxes = item.boxes.map((box) => box && plainBox(box));
    while (boxes.length && !boxes.at(-1)) boxes.pop();
    const outline = draft?.item === item ? draft.outline : null;
    saver.save({
      path: ["label", "object"],
      after: loaded,
      item: { ...makeItem(image_box), boxes: item.boxes.slice(), views: item.views.slice() },
      body: (state) => ({
        image_boxes: exchanged(state.image_boxes?.boxes ?? [], before, image_box),
        box_kind: kind(),
        object: { image_box, boxes, uid: state.labels.some(({ uid }) => uid === item.uid) ? item.uid : null },
      }),
      done: ({ uid }) => (item.uid = uid ?? item.uid),
      mine: () => ({ text: [`${image_box.label}: its box on the image and ${boxes.filter(Boolean).length} on the views`], boxes: [image_box], outlines: outline ? [outline] : [] }),
    });
  }

  /** The others' version was taken: what was drawn here stays in sight, and a click (or Enter) saves it after all. */
  function onDropped({ item }) {
    if (!item) return;
    const theirs = items.find((known) => sameBox(known.image_box, item.image_box));
    if (theirs) {
      if (draft?.item !== theirs) open(theirs);
      draft.suggestions = draft.suggestions.map((guess, i) => (theirs.boxes[i] ? null : (item.boxes[i] ?? guess)));
      show();
      return;
    }
    not_saved = [...not_saved.filter((known) => !sameBox(known.image_box, item.image_box)), item];
    show();
  }

  function takeGuess(item, image_box) {
    not_saved = not_saved.filter((known) => known !== item);
    const restored = { ...item, uid: null, stored: null, image_box: { ...plainBox(image_box), score: 1 } };
    items = [...items, restored];
    selected = restored;
    open(restored);
    saveObject(restored);
  }

  function onBusy(is_saving, error) {
    page.toggleAttribute("data-saving", is_saving);
    problem.replaceChildren();
    if (!error) return;
    problem.append(`Not saved: ${error.message} `, h("button", { type: "button", onclick: () => saver.retry() }, "Try again"));
  }

  // -- commands

  function setKind(name) {
    localStorage.setItem(KIND_KEPT, name);
    const known = app.state.frame?.image_boxes;
    if (known?.boxes.length && known.box_kind !== name && !isReadonly()) {
      saver.save({
        path: ["changes"],
        body: (state) => ({ subject: null, changes: [{ kind: "image_boxes", boxes: (state.image_boxes?.boxes ?? []).map(plainBox), box_kind: name }] }),
        mine: () => ({ text: [`All boxes say: ${name}`], boxes: [], outlines: [] }),
      });
    }
    show();
  }

  function finalise() {
    const is_final = isReadonly();
    saver.save({
      path: ["changes"],
      body: () => ({ subject: null, changes: [{ kind: is_final ? "reopen" : "finalise" }] }),
      mine: () => ({ text: [is_final ? "Opens the frame again" : "Finalises the frame"], boxes: [], outlines: [] }),
    });
  }

  function acceptNext() {
    // The object at hand first, whatever has the focus; then the next one on the image.
    const turn = [...views.editors.filter((editor) => editor === focused()), ...views.editors, image];
    return turn.some((editor) => editor.acceptSuggestion());
  }

  function deleteFocused() {
    return focused().deleteSelected();
  }

  function cancel() {
    if (editors.some((editor) => editor.isDragging && editor.cancel()) || image.cancel()) return true;
    if (!draft) return false;
    loader.stop();
    draft = null;
    show();
    return true;
  }

  function cycle(direction) {
    if (!items.length) return false;
    const index = draft ? items.indexOf(draft.item) + direction : direction > 0 ? 0 : -1;
    open(items.at(index % items.length));
    return true;
  }

  function zoomPoints(factor) {
    point_size = Math.min(Math.max(point_size * factor, POINT_LIMITS[0]), POINT_LIMITS[1]);
    show();
  }

  async function flush() {
    editors.forEach((editor) => editor.flush());
    await saver.idle();
  }

  void openRoute(app.state.route);
  return {
    route: (route) => void openRoute(route),
    flush,
    unmount() {
      loader.stop();
      app.events.openFrame(null);
      for (const end of stop) end();
      image.destroy();
      views.destroy();
    },
  };
}
