/**
 * Drawing on the pseudo-views of one object: the recursion's first two steps, which are what the detectors learn. A
 * detector suggests a box on each of the four views (dashed), and the operator accepts or corrects them; without one,
 * they are drawn: a box on the image gives the front and side view of its frustum, a box on each gives the views of the
 * next step, and a box on each of these finishes the object (the paper's Fig. 6). Every drag is saved, and the answer
 * contains the next views and suggestions.
 *
 * objects.js handles drags, suggestions.js offers whole boxes, saver.js saves, and views_pane.js shows the views.
 */

import { cameraOf, imageHeading, outline } from "../camera.js";
import { STATE_COLORS } from "../colors.js";
import { count } from "../dom.js";
import { currentFrame } from "../frame_state.js";
import { drawnObject, filledBoxes, suggestionsOf } from "./draft.js";
import { itemsOf, makeItem, naming, overlap, relabelItem, sameBox, sameItem } from "./items.js";
import { createObjects, isFinished, kindChange } from "./objects.js";
import { createSaveProblem, createSaver } from "./saver.js";
import { createWholeBoxes } from "./suggestions.js";
import { createViewsPane, hintFor } from "./views_pane.js";

/** IoU above which a detected box and that of an object are the same object. */
const SAME_OBJECT = 0.4;
/** Problems that have been shown; each is shown only once. @type {Set<string>} */
const reported = new Set();

export function createTeach(/** @type {Annotate} */ at) {
  const { app, desk, parts } = at;
  const saver = createSaver(app, desk, {
    onSaved,
    onDropped: (change) => objects.onDropped(change),
    onBusy(isSaving) {
      show();
      if (isSaving) return;
      if (saver.problem) objects.onFailed();
      else void desk.refresh();
    },
  });
  /** @type {Partial<Work>} */
  const core = {
    app,
    until: at.until,
    saver,
    items: [],
    draft: null,
    selected: null,
    notSaved: [],
    detections: [],
    show,
    report,
    setKind,
    onStored,
    get isReadonly() {
      return Boolean(app.state.frame?.frame.finalised);
    },
    get kind() {
      return app.state.frame?.image_boxes?.box_kind ?? app.state.project.settings.box_kind;
    },
  };
  const work = /** @type {Work} */ (core);
  /** @type {number | null} */
  let frameShown = null;
  let isOn = false;

  work.whole = createWholeBoxes(work);
  work.objects = createObjects(work);
  const { whole, objects } = work;
  const views = createViewsPane(work);
  const problem = createSaveProblem(app, saver, { onRelabel: rename, onDiscard: discard });
  parts.object.append(views.root);
  parts.problem.append(problem.root);
  views.root.hidden = true;
  at.until.addEventListener("abort", close);

  // -- the frame's objects

  /** The frame's state was set: a new frame, an undo, or a change by others. */
  function settle() {
    const state = currentFrame(app);
    const isNew = frameShown !== state.frame.id;
    if (saver.isBusy && !isNew) return;
    if (isNew) {
      frameShown = state.frame.id;
      close();
      work.notSaved = [];
      work.detections = [];
      void detect(state);
    }
    work.items = itemsOf(state);
    if (work.draft) keepDraft(work.draft);
    show();
  }

  function keepDraft(/** @type {Draft} */ draft) {
    const known = draft.item;
    const index = work.items.findIndex(
      (item) => sameBox(item.image_box, known.stored) || (item.uid && item.uid === known.uid),
    );
    if (index < 0) {
      if (known.stored || !known.found || !desk.stored(known.found)) follow();
    } else if (sameItem(work.items[index], known)) {
      known.uid = work.items[index].uid;
      known.stored = work.items[index].stored;
      work.items[index] = known;
      // the confirmation of its whole box may have been undone
      void whole.follow(draft);
    } else objects.open(work.items[index]);
  }

  function onSaved(/** @type {FrameState} */ state) {
    const fresh = itemsOf(state);
    // this page's boxes are newer than any answer; the server adds uids and the boxes of others
    work.items = fresh.map((item) => work.items.find((known) => sameBox(known.stored, item.image_box)) ?? item);
    work.items.forEach((item, i) => {
      item.uid = fresh[i].uid;
    });
    const current = work.draft?.item;
    if (current && isFinished(current)) desk.select(current.uid);
    else if (current && !work.items.includes(current)) follow();
    show();
  }

  /** Shows the boxes that the image detector finds on a frame on which there is nothing to review. */
  async function detect(/** @type {FrameState} */ { frame, labels }) {
    const isOpen = labels.some(({ state }) => state === "proposed");
    if (!app.state.project.detectors.image || frame.finalised || isOpen) return;
    const { boxes, problem } = await app.api.get(app.path("frames", frame.id, "label", "suggestions"));
    report("image", problem);
    if (frameShown !== frame.id) return;
    work.detections = boxes;
    show();
  }

  /** An object is about to be stored: it replaces the box that was found for it. */
  function onStored(/** @type {Item} */ item) {
    const { found } = item;
    // what was found or proposed may have got another class since
    const own = work.items.includes(item) ? null : desk.stored(found ?? item.uid ?? "");
    if (own) relabelItem(item, naming({ [item.image_box.label]: desk.seen(own).label }));
    item.found = null;
    if (found) desk.drop(found);
  }

  /** Says why a detector suggests nothing. */
  function report(/** @type {Api.DetectorKind} */ role, /** @type {string | null | undefined} */ problem) {
    const key = `${app.state.route.project}: ${problem}`;
    if (!problem || reported.has(key)) return;
    reported.add(key);
    app.toast(`No suggestions: the ${role} detector cannot be loaded. ${problem}`, "warn");
  }

  /** Makes the object of the selected box the current one; without one, none. */
  function follow() {
    const item = isOn ? itemOf(desk.shown) : null;
    if (item && item === work.draft?.item) return;
    work.selected = null;
    if (item) objects.open(item);
    else if (!work.draft || work.draft.item.uid || work.draft.item.found || desk.uid !== null || !isOn) close();
  }

  /**
   * The object with a box: as it was drawn, or else the part of the image that the box covers; null: it is outside.
   *
   * @returns {Item | null}
   */
  function itemOf(/** @type {PageLabel | null} */ label) {
    if (!label) return null;
    const known = work.items.find(({ uid }) => uid === label.uid);
    if (known) return known;
    const current = work.draft?.item;
    if (current && (current.found ?? current.uid) === label.uid) return current;
    const drawn = (label.isNew && desk.imageBox(label.uid)) || rectangle(label);
    if (!drawn) return null;
    return { ...makeItem({ ...drawn, score: 1 }), ...(label.isNew ? { found: label.uid } : { uid: label.uid }) };
  }

  function rectangle(/** @type {PageLabel} */ label) {
    const { width, height } = currentFrame(app).image;
    const points = outline(cameraOf(currentFrame(app).image), label.box).flat();
    const clip = (/** @type {number} */ value, /** @type {number} */ length) =>
      Math.min(Math.max(value, -0.5), length - 0.5);
    const [x, y] = [points.map((point) => clip(point[0], width)), points.map((point) => clip(point[1], height))];
    const box = { x_min: Math.min(...x), y_min: Math.min(...y), x_max: Math.max(...x), y_max: Math.max(...y) };
    return box.x_max - box.x_min >= 1 && box.y_max - box.y_min >= 1 ? { label: label.label, ...box } : null;
  }

  function close() {
    objects.close();
    work.selected = null;
  }

  // -- showing

  function show() {
    problem.show();
    views.show(isOn ? work.draft : null);
    at.showDrawn();
  }

  /** The objects whose boxes on the image are shown: the current one, and those that are not finished. */
  const onImage = () => work.items.filter((item) => (item === work.draft?.item || !item.uid) && !isReplaced(item));
  /** This page has another version, which is not saved. */
  const isReplaced = (/** @type {Item} */ { image_box }) =>
    work.notSaved.some((item) => sameBox(item.image_box, image_box));

  /**
   * Dashed boxes on the image, with their objects: this page's unsaved boxes, and detected ones at places where there is
   * nothing.
   */
  function guesses() {
    if (work.isReadonly) return [];
    const taken = [
      ...work.items.map(({ image_box }) => image_box),
      ...desk.labels().flatMap((label) => (label.state === "rejected" ? [] : (rectangle(label) ?? []))),
    ];
    const free = work.detections.filter((box) => !taken.some((known) => overlap(known, box) > SAME_OBJECT));
    const guess = (/** @type {Item} */ item, /** @type {string} */ caption) => {
      return { item, box: { ...item.image_box, suggested: true, caption } };
    };
    return [
      ...work.notSaved.map((item) => guess(item, "yours, not saved")),
      ...free.map((box) => guess(makeItem(box), `${box.label} ${Math.round(100 * (box.score ?? 1))} %`)),
    ];
  }

  /** The boxes for the editor of the camera image, with the objects that they belong to, and which is selected. */
  function shown() {
    const boxes = onImage().map((item) => ({
      item,
      box: { ...item.image_box, faint: item !== work.draft?.item, caption: item.image_box.label },
    }));
    return { list: [...boxes, ...guesses()], selected: boxes.findIndex(({ item }) => item === work.selected) };
  }

  /** The 3D box so far, or the whole box that is offered. @returns {Overlay[]} */
  function overlays() {
    const { draft } = work;
    const lines = [];
    const look = { color: STATE_COLORS.proposed, dash: true, strong: true };
    if (isOn && draft?.answer.outline && !isFinished(draft.item) && !draft.item.found)
      lines.push({ segments: draft.answer.outline, ...look });
    const offered = whole.offered();
    if (offered) {
      const heading = imageHeading(cameraOf(currentFrame(app).image), offered.box);
      lines.push({ segments: offered.outline, heading, ...look, id: "whole" });
    }
    return lines.filter(({ segments }) => segments.length > 0);
  }

  function hint() {
    if (!isOn) {
      const isEmpty = desk.labels().length === 0 && guesses().length > 0;
      return isEmpty ? "Click a dashed box to get its 3D box. Or drag one around another object." : "";
    }
    return hintFor(work);
  }

  // -- what the operator does

  function turn(/** @type {boolean} */ on) {
    isOn = on;
    views.root.hidden = !on;
    parts.ortho.hidden = on;
    if (!on) void at.ortho.show();
    follow();
    show();
  }

  /**
   * Accepts what is suggested for the current object, or its whole box; false if there is nothing, or if the object's
   * box is a proposal that nothing was drawn for: that one is accepted as it is.
   */
  function accept() {
    // while boxes are being looked for, the key waits for them
    return (isOwn() && (Boolean(work.draft?.isLoading) || objects.acceptAll())) || whole.confirm();
  }

  /** Something was drawn for the current object, or it has no 3D box. */
  const isOwn = () =>
    Boolean(work.draft && (work.draft.changes > 0 || !(work.draft.item.found ?? work.draft.item.uid)));

  const canAccept = () =>
    (isOwn() && work.draft !== null && suggestionsOf(work.draft).some(Boolean)) || Boolean(whole.offered());

  /** What boxes enclose belongs to the project; the boxes of this frame become boxes of this kind. */
  function setKind(/** @type {Api.BoxKind} */ kind) {
    const { project } = app.state;
    if (kind !== project.settings.box_kind) {
      app.state.set({ project: { ...project, settings: { ...project.settings, box_kind: kind } } });
      void app.api.put(app.path("box-kind"), { box_kind: kind });
    }
    const known = app.state.frame?.image_boxes;
    if (known?.boxes.length && known.box_kind !== kind && !work.isReadonly) saver.save(kindChange(kind));
    void objects.askAgain();
    show();
  }

  function rename(/** @type {Record<string, string>} */ renamed) {
    const named = naming(renamed);
    work.detections = work.detections.map(named);
    for (const item of new Set([...work.items, ...work.notSaved])) relabelItem(item, named);
    for (const step of work.draft?.answer.steps ?? []) step.suggested = step.suggested.map(named);
    saver.relabel(renamed);
    show();
  }

  function discard() {
    saver.discard();
    // this discards what was drawn, too
    app.frames.take(currentFrame(app));
  }

  return {
    get isOn() {
      return isOn;
    },
    get draft() {
      return work.draft;
    },
    /** Whether changes are being sent, or wait for a second try. */
    get isSaving() {
      return saver.isBusy;
    },
    /** Whether there is something that `accept` takes. */
    get canAccept() {
      return canAccept();
    },
    /** The objects that have no 3D box yet. */
    get unfinished() {
      return work.items.filter((item) => !item.uid);
    },
    shown,
    overlays,
    hint,
    show,
    settle,
    follow,
    turn,
    accept,
    rename,
    nextWhole: () => whole.next(),

    /** A box was drawn on the image for a new object, in which nothing was found, or which is to be drawn. */
    draw(/** @type {Box2D} */ box) {
      desk.select(null);
      if (!isOn) turn(true);
      objects.draw(box);
    },
    /** A box on the image was changed; `entry` is one of `shown`. */
    changeImageBox: objects.onImageChange,
    /** Opens an object that is not finished, or the object of a box. */
    open(/** @type {Item} */ item) {
      if (!isOn) turn(true);
      desk.select(item.uid);
      work.selected = item;
      if (item !== work.draft?.item) objects.open(item);
      else show();
    },
    /** Deletes the selected box of a focused view, or the object that has no 3D box; false if there is neither. */
    removeDrawn() {
      const view = views.editors.find((editor) => editor.root.contains(document.activeElement));
      if (view) {
        view.deleteSelected();
        return true;
      }
      const item = work.draft?.item;
      if (!isOn || !item || item.uid || item.found) return false;
      objects.remove(item);
      return true;
    },
    /** The box on the image is not selected any more, so that a drag in it draws another one. */
    release() {
      work.selected = null;
    },
    remove: objects.remove,
    /** Gives the current object another class with all its boxes; false if none is drawn. */
    setClass(/** @type {string} */ name) {
      const item = work.draft?.item;
      if (!isOn || !item || item.found || (item.uid && !work.items.includes(item))) return false;
      if (item.uid) work.selected = item;
      objects.pickClass(name);
      return true;
    },
    /** Cancels a drag on the views, or else closes the object; false if there is neither. */
    cancel() {
      if (views.editors.some((editor) => editor.cancel())) return true;
      if (!work.draft || work.draft.item.uid || work.draft.item.found) return false;
      close();
      show();
      return true;
    },
    /** The object as the 3D view draws it, while its views are not being loaded. */
    sceneDraft() {
      const { draft } = work;
      if (!isOn || !draft || work.isReadonly || draft.isLoading) return null;
      return { ...drawnObject(draft.item, filledBoxes(draft)), box_kind: work.kind };
    },
    fit() {
      for (const editor of views.editors) editor.fit();
    },

    async flush() {
      for (const editor of views.editors) editor.flush();
      await saver.idle();
    },
    /** What would be lost if the frame were left now; null if everything is saved. @returns {Unsaved | null} */
    get unsaved() {
      const isSent = work.items.every(({ stored, image_box }) => sameBox(stored, image_box));
      if (!saver.isBusy && isSent) return null;
      const text =
        `Not saved: ${count(saver.waiting, "change")} of this frame. ${saver.problem?.message ?? ""}`.trim();
      return { text, retry: saver.retry, discard };
    },
  };
}
