/** The effects of a drag on the object that is being drawn: its views, its boxes, its class, and what is saved. */

import { messageOf } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { createMoves, demoteSecondStep, drawnObject, makeDraft, takeSteps } from "./draft.js";
import { exchanged, makeItem, plainBox, relabelItem, sameBox, suggestionOf } from "./items.js";

/** True if an object has all its boxes and a label. */
export const isFinished = (/** @type {Item} */ item) => Boolean(item.uid) && item.boxes.every(Boolean);

/**
 * @param {ModeApp} app
 * @param {Work} work
 * @param {{ saver: Saver, loader: StepLoader, suggester: Suggester, whole: WholeBoxes, show: () => void,
 *     onStored: (item: Item) => void }} parts onStored: called when an object is about to be stored.
 */
export function createObjects(app, work, parts) {
  const { saver, loader, suggester, whole, show, onStored } = parts;
  const kind = () => work.kind;
  const moves = createMoves(loader);

  /** Makes an object the current one and fetches its views. */
  function open(/** @type {Item} */ item) {
    begin(item);
    work.loaded = loadSteps();
    show();
  }

  /** @returns {Draft} */
  function begin(/** @type {Item} */ item) {
    moves.leave(work.draft);
    const draft = moves.draftOf(item) ?? makeDraft(item, currentFrame(app).frame.id);
    work.draft = draft;
    return draft;
  }

  /** Closes the current object. */
  function close() {
    moves.leave(work.draft);
    suggester.stop();
    whole.stop();
    work.draft = null;
  }

  /** Loads the current object's views. */
  async function loadSteps() {
    const loading = work.draft;
    if (!loading) return;
    const { item } = loading;
    suggester.stop();
    try {
      // a moved object is saved afterwards, and the answer to that contains suggestions
      const isNewest = await moves.load(loading, !moves.isWaiting(item));
      if (!isNewest || work.draft !== loading) return;
    } catch (error) {
      loading.stop = messageOf(error);
      // the views of the old box must not be drawn on
      if (moves.isWaiting(item)) loading.steps = [];
      if (work.draft !== loading) return;
    }
    showViews(loading);
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
    if (work.draft === draft && draft.changes === changes) work.loaded = loadSteps();
  }

  function showViews(/** @type {Draft} */ draft) {
    if (draft.item.boxes.every(Boolean)) draft.outline = null;
    show();
    void suggester.follow(draft);
    void whole.follow(draft);
  }

  // -- boxes on the image

  /** The operator has changed a box on the image: that of an object, or a dashed one, which becomes an object. */
  function onImageChange(
    /** @type {Item} */ item,
    /** @type {Box2D} */ box,
    /** @type {EditKind} */ why,
    /** @type {number} */ actions,
  ) {
    app.effort.action(actions);
    if (!work.items.includes(item)) takeGuess(item, box);
    else if (why === "delete") removeItem(item);
    else changeImageBox(item, plainBox(box));
  }

  /** A box was drawn on the image for a new object. */
  function draw(/** @type {Box2D} */ box) {
    app.effort.action();
    add(makeItem(plainBox(box)));
  }

  function add(/** @type {Item} */ item) {
    work.items = [...work.items, item];
    work.selected = item;
    if (item.boxes.some(Boolean)) {
      // its views may belong to another box on the image
      changeImageBox(item, item.image_box);
      return;
    }
    save(begin(item));
    show();
  }

  function takeGuess(/** @type {Item} */ item, /** @type {Box2D} */ box) {
    work.notSaved = work.notSaved.filter((known) => known !== item);
    add({ ...item, uid: null, stored: null, image_box: { ...plainBox(box), score: 1 } });
  }

  function changeImageBox(/** @type {Item} */ item, /** @type {Box2D} */ box) {
    item.image_box = box;
    const draft = work.draft?.item === item ? work.draft : begin(item);
    if (item.boxes.some(Boolean) || item.uid) followMove(draft);
    else save(draft);
    show();
  }

  /** Saves an object whose views have changed, after its boxes were transferred to the new views. */
  function followMove(/** @type {Draft} */ draft) {
    const { item } = draft;
    const isWaiting = moves.isWaiting(item);
    if (!isWaiting) moves.start(draft);
    draft.changes += 1;
    work.loaded = loadSteps();
    if (isWaiting) void saver.retry();
    else saver.save({ item, make: () => followed(item) });
  }

  /** The change of an object whose image box was moved, once its boxes are on the new views; null if it is gone. */
  async function followed(/** @type {Item} */ item) {
    const isThere = await moves.settle(item, (draft) => {
      if (work.draft === draft) work.loaded = loadSteps();
      else void moves.load(draft, false);
    });
    const draft = moves.draftOf(item);
    return isThere && draft ? changeOf(draft) : null;
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
    draft.suggestions[index] = null;
    draft.kept[index] = false;
    const isMove = index < 2 && [2, 3].some((later) => item.boxes[later]);
    if (isMove) followMove(draft);
    else save(draft);
    if (item.boxes.every(Boolean)) work.selected = null;
    show();
  }

  /** Accepts all suggested boxes of the current object; false if there is none. */
  function acceptAll() {
    const { draft } = work;
    if (!draft || work.isReadonly || draft.isLoading || !draft.suggestions.some(Boolean)) return false;
    app.effort.action();
    accept(draft, [0, 1, 2, 3]);
    save(draft);
    if (draft.item.boxes.every(Boolean)) work.selected = null;
    show();
    return true;
  }

  function accept(/** @type {Draft} */ { item, suggestions, suggestion, kept }, /** @type {number[]} */ indices) {
    for (const index of indices) {
      if (suggestions[index] && !item.boxes[index] && !kept[index]) item.suggested[index] = suggestion;
      const box = item.boxes[index] ?? suggestions[index];
      item.boxes[index] = box && { ...plainBox(box), score: 1 };
      suggestions[index] = null;
      kept[index] = false;
    }
  }

  function clearViewBox(/** @type {number} */ index, /** @type {number} */ actions) {
    app.effort.action(actions);
    const { draft } = work;
    if (!draft) return;
    draft.item.boxes[index] = null;
    draft.item.suggested[index] = null;
    if (index < 2) demoteSecondStep(draft);
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
    removeItem(item);
  }

  function removeItem(/** @type {Item} */ item) {
    work.items = work.items.filter((other) => other !== item);
    moves.forget(item);
    if (work.draft?.item === item) close();
    saver.save(removal(item, kind));
    show();
  }

  /** Saves an object as it is now; while it waits for its views, it is saved when they are loaded. */
  function save(/** @type {Draft} */ draft) {
    onStored(draft.item);
    if (!work.items.includes(draft.item)) work.items = [...work.items, draft.item];
    draft.changes += 1;
    draft.whole = null;
    suggester.stop();
    if (moves.isWaiting(draft.item)) return;
    draft.isLoading = true;
    saver.save(changeOf(draft));
  }

  function changeOf(/** @type {Draft} */ draft) {
    const { changes } = draft;
    return objectChange(draft, {
      after: work.loaded,
      kind,
      onDrawn(drawn) {
        // after a newer change, its answer counts
        if (draft.changes !== changes) return;
        draft.isLoading = false;
        takeSteps(draft, drawn);
        if (work.draft === draft) showViews(draft);
      },
    });
  }

  /** A change could not be saved, so there is no answer with its views. */
  function onFailed() {
    if (work.draft) work.draft.isLoading = false;
    show();
  }

  /** The others' version was kept. The dropped change stays visible; a click or Enter saves it. */
  function onDropped(/** @type {FrameChange | LaterChange} */ { item }) {
    if (!item) return;
    // boxes that have not been transferred yet are not on any view of the moved object
    const boxes = moves.isWaiting(item) ? [] : item.boxes;
    moves.forget(item);
    const theirs = work.items.find((known) => sameBox(known.image_box, item.image_box));
    if (theirs) {
      if (work.draft?.item !== theirs) open(theirs);
      boxes.forEach((box, i) => {
        if (!work.draft || !box || theirs.boxes[i]) return;
        work.draft.suggestions[i] = box;
        work.draft.kept[i] = true;
      });
    } else {
      work.notSaved = [...work.notSaved.filter((known) => !sameBox(known.image_box, item.image_box)), item];
    }
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
 * @param {Promise<unknown>} options.after
 * @param {() => Api.BoxKind} options.kind
 * @param {(drawn: Api.StepsOut) => void} options.onDrawn called with the views and suggestions that follow.
 * @returns {FrameChange}
 */
export function objectChange(draft, { after, kind, onDrawn }) {
  const { item, outline } = draft;
  const drawn = drawnObject(draft);
  const suggestion = suggestionOf(item);
  const kept = { ...makeItem(drawn.image_box), boxes: item.boxes.slice(), views: item.views.slice() };
  kept.stored = item.stored;
  item.stored = drawn.image_box;
  return {
    path: ["label", "object"],
    after,
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
