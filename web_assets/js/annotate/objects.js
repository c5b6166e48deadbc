/** The effects of a drag on the object that is being drawn: its views, its boxes, its class, and what is saved. */

import { isAborted, messageOf } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { drawnObject, makeDraft, suggestionsOf, takeProblem, takeSteps } from "./draft.js";
import { exchanged, makeItem, plainBox, relabelItem, sameBox, suggestionOf } from "./items.js";

/** While a detector is being loaded, its suggestions are asked for so often, ms. */
const LOADING_WAIT_MS = 1500;

/** True if an object has all its boxes and a label. */
export const isFinished = (/** @type {Item} */ item) => Boolean(item.uid) && item.boxes.every(Boolean);

export function createObjects(/** @type {Work} */ work) {
  const { app, show, saver } = work;
  const kind = () => work.kind;
  let request = new AbortController();

  /** Makes an object the current one and fetches its views. */
  function open(/** @type {Item} */ item) {
    void load(begin(item), 0);
    show();
  }

  function begin(/** @type {Item} */ item) {
    request.abort();
    work.draft = makeDraft(item, currentFrame(app).frame.id);
    return work.draft;
  }

  /** Closes the current object. */
  function close() {
    request.abort();
    work.whole.stop();
    work.draft = null;
  }

  /** Loads an object's views after a while, and again while the detector is being loaded; any change ends that. */
  async function load(/** @type {Draft} */ draft, /** @type {number} */ waitMs) {
    request.abort();
    request = new AbortController();
    const { signal } = request;
    const { changes } = draft;
    draft.isLoading = waitMs === 0;
    try {
      await new Promise((resolve) => setTimeout(resolve, waitMs));
      if (signal.aborted) return;
      const body = { ...drawnObject(draft.item), box_kind: kind() };
      const answer = await app.api.post(app.path("frames", draft.frame, "label", "steps"), body, { signal });
      if (!signal.aborted && draft.changes === changes) takeAnswer(draft, answer);
    } catch (error) {
      if (isAborted(error) || signal.aborted) return;
      takeProblem(draft, messageOf(error));
      show();
    }
  }

  function takeAnswer(/** @type {Draft} */ draft, /** @type {Api.StepsOut} */ answer) {
    takeSteps(draft, answer);
    if (work.draft !== draft) return;
    work.report("view", answer.problem);
    show();
    void work.whole.follow(draft);
    if (answer.detector === "loading") void load(draft, LOADING_WAIT_MS);
  }

  /**
   * Replaces the current object's suggestions once another kind of boxes is saved, for which they were not made. Until
   * then, Enter waits.
   */
  async function askAgain() {
    const { draft } = work;
    if (!draft) return;
    // answers that are on their way contain suggestions of the other kind
    draft.changes += 1;
    const { changes } = draft;
    draft.isLoading = true;
    await saver.idle();
    // the answer to a newer change contains new suggestions
    if (work.draft === draft && draft.changes === changes) void load(draft, 0);
  }

  // -- boxes on the image

  /** The operator has changed a box on the image: that of an object, or a dashed one, which becomes an object. */
  function onImageChange(/** @type {Item} */ item, /** @type {Box2D} */ box, /** @type {number} */ actions) {
    app.effort.action(actions);
    if (!work.items.includes(item)) takeGuess(item, box);
    else {
      item.image_box = plainBox(box);
      save(work.draft?.item === item ? work.draft : begin(item));
      show();
    }
  }

  /** A box was drawn on the image for a new object. */
  function draw(/** @type {Box2D} */ box) {
    app.effort.action();
    add(makeItem(plainBox(box)));
  }

  function add(/** @type {Item} */ item) {
    work.items = [...work.items, item];
    work.selected = item;
    save(begin(item));
    show();
  }

  function takeGuess(/** @type {Item} */ item, /** @type {Box2D} */ box) {
    work.notSaved = work.notSaved.filter((known) => known !== item);
    // an object that was changed by others, too
    const theirs = work.items.find((known) => sameBox(known.image_box, item.image_box));
    work.items = work.items.filter((known) => known !== theirs);
    const { uid, stored } = theirs ?? { uid: null, stored: null };
    add({ ...item, uid, stored, image_box: { ...plainBox(box), score: 1 } });
  }

  // -- boxes on the views

  function setViewBox(/** @type {number} */ index, /** @type {Box2D} */ box, /** @type {number} */ actions) {
    app.effort.action(actions);
    const { draft } = work;
    if (!draft) return;
    const { item } = draft;
    // a box on the second step confirms the first one, from which its views follow
    if (index >= 2) accept(draft, [0, 1]);
    item.boxes[index] = { ...plainBox(box), label: item.image_box.label, score: 1 };
    item.suggested[index] = null;
    save(draft);
    if (item.boxes.every(Boolean)) work.selected = null;
    show();
  }

  /** Accepts all suggested boxes of the current object; false if there is none. */
  function acceptAll() {
    const { draft } = work;
    if (!draft || work.isReadonly || draft.isLoading || !suggestionsOf(draft).some(Boolean)) return false;
    app.effort.action();
    accept(draft, [0, 1, 2, 3]);
    save(draft);
    if (draft.item.boxes.every(Boolean)) work.selected = null;
    show();
    return true;
  }

  function accept(/** @type {Draft} */ draft, /** @type {number[]} */ indices) {
    const { item, answer } = draft;
    const suggestions = suggestionsOf(draft);
    for (const index of indices) {
      const box = suggestions[index];
      if (!box) continue;
      item.suggested[index] = answer.suggestion;
      item.boxes[index] = { ...plainBox(box), score: 1 };
    }
  }

  function clearViewBox(/** @type {number} */ index, /** @type {number} */ actions) {
    app.effort.action(actions);
    const { draft } = work;
    if (!draft) return;
    draft.item.boxes[index] = null;
    draft.item.suggested[index] = null;
    save(draft);
    show();
  }

  // -- the object as a whole

  function pickClass(/** @type {string} */ name) {
    const item = work.draft?.item;
    if (item && !work.isReadonly && (work.selected === item || !isFinished(item)) && item.image_box.label !== name) {
      app.effort.action();
      item.image_box = { ...item.image_box, label: name };
      item.boxes = item.boxes.map((box) => box && { ...box, label: name });
      if (work.draft) save(work.draft);
    }
    show();
  }

  function remove(/** @type {Item} */ item) {
    app.effort.action();
    work.items = work.items.filter((other) => other !== item);
    if (work.draft?.item === item) close();
    saver.save(removal(item, kind));
    show();
  }

  /** Saves an object as it is now; the answer has its views. */
  function save(/** @type {Draft} */ draft) {
    work.onStored(draft.item);
    if (!work.items.includes(draft.item)) work.items = [...work.items, draft.item];
    request.abort();
    draft.changes += 1;
    draft.whole = null;
    draft.isLoading = true;
    const { changes } = draft;
    saver.save(
      objectChange(draft, {
        kind,
        onDrawn(answer) {
          // after a newer change, its answer counts
          if (draft.changes === changes) takeAnswer(draft, answer);
        },
      }),
    );
  }

  /** A change could not be saved, so there is no answer with its views. */
  function onFailed() {
    if (work.draft) work.draft.isLoading = false;
    show();
  }

  /** The others' version was kept. The dropped object stays visible, dashed; a click saves it. */
  function onDropped(/** @type {FrameChange} */ { item }) {
    if (!item) return;
    work.notSaved = [...work.notSaved.filter((known) => !sameBox(known.image_box, item.image_box)), item];
    show();
  }

  return {
    open,
    askAgain,
    close,
    acceptAll,
    onFailed,
    onImageChange,
    draw,
    setViewBox,
    clearViewBox,
    pickClass,
    remove,
    onDropped,
  };
}

// -- the changes of a frame, for saver.js

/**
 * Saves an object as it is now. Afterwards `stored` is its image box, which later changes replace.
 *
 * @param {Draft} draft
 * @param {object} options
 * @param {() => Api.BoxKind} options.kind
 * @param {(answer: Api.StepsOut) => void} options.onDrawn called with the views and suggestions that follow.
 * @returns {FrameChange}
 */
export function objectChange(draft, { kind, onDrawn }) {
  const { item } = draft;
  const { outline } = draft.answer;
  const drawn = drawnObject(item);
  const suggestion = suggestionOf(item);
  const kept = { ...makeItem(drawn.image_box), boxes: item.boxes.slice(), views: item.views.slice() };
  kept.stored = item.stored;
  item.stored = drawn.image_box;
  return {
    path: ["label", "object"],
    item: kept,
    relabel(named) {
      relabelItem(kept, named);
      drawn.image_box = named(drawn.image_box);
      drawn.boxes = drawn.boxes.map(named);
    },
    body: (state) => ({
      image_boxes: exchanged(state.image_boxes?.boxes ?? [], kept.stored, drawn.image_box),
      box_kind: kind(),
      object: { ...drawn, uid: state.labels.some(({ uid }) => uid === item.uid) ? item.uid : null, suggestion },
    }),
    stateOf: ({ state }) => state,
    done({ uid, drawn: following }) {
      item.uid = uid ?? item.uid;
      if (following) onDrawn(following);
    },
    mine: () => ({
      text: [`${drawn.image_box.label}: its box on the image and ${drawn.boxes.filter(Boolean).length} on the views`],
      boxes: [drawn.image_box],
      outlines: outline ? [outline] : [],
    }),
  };
}

/** Deletes an object with its label. @returns {FrameChange} */
export function removal(/** @type {Item} */ item, /** @type {() => Api.BoxKind} */ kind) {
  const { image_box } = item;
  return {
    path: ["changes"],
    relabel: (named) => relabelItem(item, named),
    // made when it is sent: the answer to an earlier change may contain the uid and the stored box
    body: (state) => ({
      subject: item.uid,
      changes: [
        ...(state.labels.some(({ uid }) => uid === item.uid) ? [{ kind: "delete", uid: item.uid }] : []),
        { kind: "image_boxes", boxes: exchanged(state.image_boxes?.boxes ?? [], item.stored, null), box_kind: kind() },
      ],
    }),
    mine: () => ({ text: [`Deletes this ${image_box.label}`], boxes: [image_box], outlines: [] }),
  };
}

/** Changes the kind of all boxes of the frame: what they enclose. @returns {FrameChange} */
export function kindChange(/** @type {Api.BoxKind} */ kind) {
  return {
    path: ["changes"],
    body: (state) => ({
      subject: null,
      changes: [{ kind: "image_boxes", boxes: (state.image_boxes?.boxes ?? []).map(plainBox), box_kind: kind }],
    }),
    mine: () => ({
      text: [kind === "box" ? "All boxes enclose the whole object" : "All boxes enclose the visible part"],
      boxes: [],
      outlines: [],
    }),
  };
}
