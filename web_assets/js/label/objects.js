/** The effects of a drag on the object that is being drawn: its views, its boxes, its class, and what is saved. */

import { headingTurned } from "../box3d.js";
import { messageOf } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { boxChange, objectChange, removal } from "./changes.js";
import { isFinished } from "./display.js";
import { createMoves, demoteSecondStep, makeDraft, takeSteps } from "./draft.js";
import { makeItem, plainBox, sameBox } from "./items.js";
import { openGuesses } from "./work.js";

/** Maximum time that the 3D view waits for the pictures of views. */
const PICTURES_WAIT_MS = 400;

/** Resolves after the page was painted: a task queued by an animation callback runs after the painting. */
function painted() {
  return new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
}

/**
 * @param {ModeApp} app
 * @param {Work} work
 * @param {{ saver: Saver, loader: StepLoader, suggester: Suggester, whole: WholeBoxes, prefetch: Prefetch,
 *     image: Editor, views: ViewsPane, show: () => void }} parts
 */
export function createObjects(app, work, parts) {
  const { saver, loader, suggester, whole, prefetch, image, views, show } = parts;
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
    work.label = item.image_box.label;
    return draft;
  }

  function openLabel(/** @type {string} */ uid) {
    const item = work.items.find((known) => known.uid === uid);
    if (item) open(item);
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
    prefetch.stop();
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
    await showViews(loading);
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

  /** Shows new views; once they are on the screen, the 3D view and prefetching may begin. */
  async function showViews(/** @type {Draft} */ draft) {
    if (draft.item.boxes.every(Boolean)) draft.outline = null;
    const own = {};
    work.coming = own;
    show();
    await Promise.race([views.shown().then(painted), new Promise((resolve) => setTimeout(resolve, PICTURES_WAIT_MS))]);
    if (work.coming !== own || work.draft !== draft) return;
    work.coming = null;
    show();
    void suggester.follow(draft);
    void whole.follow(draft);
    prefetch.start();
  }

  // -- boxes on the image

  function onImageSelect(/** @type {number} */ index) {
    const item = work.items[index];
    work.selected = item ?? null;
    if (item && item !== work.draft?.item) open(item);
  }

  function onImageChange(
    /** @type {Box2D[]} */ boxes,
    /** @type {EditKind} */ why,
    /** @type {number} */ index,
    /** @type {number} */ actions,
  ) {
    app.effort.action(actions);
    if (index >= work.items.length && why !== "draw")
      takeGuess(openGuesses(work)[index - work.items.length].item, boxes[index]);
    else if (why === "draw") add(makeItem(plainBox(boxes[index])));
    else if (why === "delete") removeItem(work.items[index]);
    else changeImageBox(work.items[index], plainBox(boxes[index]));
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
    if (item.boxes.every(Boolean)) image.select(-1);
    show();
  }

  /** Accepts all suggested boxes of the current object; false if there is none. */
  function acceptAll() {
    const { draft } = work;
    if (!draft || work.isReadonly || draft.isLoading || !draft.suggestions.some(Boolean)) return false;
    app.effort.action();
    accept(draft, [0, 1, 2, 3]);
    save(draft);
    if (draft.item.boxes.every(Boolean)) image.select(-1);
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
    work.label = name;
    const item = work.draft?.item;
    if (item && !work.isReadonly && (work.selected === item || !isFinished(item)) && item.image_box.label !== name) {
      app.effort.action();
      item.image_box = { ...item.image_box, label: name };
      item.boxes = item.boxes.map((box) => box && { ...box, label: name });
      if (work.draft) save(work.draft);
    }
    show();
  }

  /** Turns the 3D box of the finished object by so many quarters; false if there is none. */
  function turn(/** @type {number} */ quarters) {
    const item = work.draft?.item;
    const label = app.state.frame?.labels.find(({ uid }) => uid === item?.uid);
    if (!item || !label || work.isReadonly) return false;
    app.effort.action();
    const { outline, box } = label;
    saver.save(boxChange(label, headingTurned(box, quarters), { kind: null, item, words: "turned", outline }));
    return true;
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
    draft.changes += 1;
    draft.whole = null;
    suggester.stop();
    prefetch.stop();
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
        if (work.draft === draft) void showViews(draft);
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

  function cycle(/** @type {number} */ direction) {
    if (!work.items.length) return false;
    const index = work.draft ? work.items.indexOf(work.draft.item) + direction : direction > 0 ? 0 : -1;
    const item = work.items.at(index % work.items.length);
    if (item) open(item);
    return true;
  }

  return {
    open,
    openLabel,
    askAgain,
    close,
    acceptAll,
    onFailed,
    onImageSelect,
    onImageChange,
    setViewBox,
    clearViewBox,
    pickClass,
    turn,
    remove,
    onDropped,
    cycle,
  };
}
