/** The effects of a drag on the object that is being drawn: its views, its boxes, its class, and what is saved. */

import { messageOf } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { objectChange, removal } from "./changes.js";
import { isFinished } from "./display.js";
import { demoteSecondStep, makeDraft } from "./draft.js";
import { makeItem, openStep, plainBox, sameBox } from "./items.js";
import { createMoves } from "./moves.js";
import { openGuesses } from "./work.js";

/** Maximum time that saving and suggestions wait for a picture. */
const PICTURES_WAIT_MS = 400;

/** Resolves after the page was painted: a task queued by an animation callback runs after the painting. */
function painted() {
  return new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
}

/**
 * @param {ModeApp} app
 * @param {Work} work
 * @param {{ saver: Saver, loader: StepLoader, suggester: Suggester, prefetch: Prefetch, image: Editor,
 *     views: ViewsPane, show: () => void }} parts
 */
export function createObjects(app, work, parts) {
  const { saver, loader, suggester, prefetch, image, views, show } = parts;
  const kind = () => work.kind;
  const moves = createMoves(loader);

  /**
   * Makes an object the current one and fetches its views.
   *
   * @param {Item} item
   */
  function open(item) {
    begin(item);
    work.loaded = loadSteps();
    show();
  }

  /** @param {Item} item */
  function begin(item) {
    moves.leave(work.draft);
    work.draft = moves.draftOf(item) ?? makeDraft(item, currentFrame(app).frame.id);
    work.step = openStep(item);
    work.label = item.image_box.label;
  }

  /** @param {string} uid */
  function openLabel(uid) {
    const item = work.items.find((known) => known.uid === uid);
    if (item) open(item);
  }

  /** Closes the current object. */
  function close() {
    moves.leave(work.draft);
    suggester.stop();
    work.draft = null;
  }

  /** Loads the current object's views; then saving, the 3D view, suggestions and prefetching may begin. */
  async function loadSteps() {
    const loading = work.draft;
    if (!loading) return;
    const { item } = loading;
    const own = {};
    work.coming = own;
    suggester.stop();
    prefetch.stop();
    try {
      const isNewest = await moves.load(loading);
      if (!isNewest || work.draft !== loading) return;
      if (item.boxes.every(Boolean)) loading.outline = null;
    } catch (error) {
      loading.stop = messageOf(error);
      // the views of the old box must not be drawn on
      if (moves.isWaiting(item)) loading.steps = [];
      if (work.draft !== loading) return;
    }
    work.step = openStep(item);
    show();
    await Promise.race([views.shown().then(painted), new Promise((resolve) => setTimeout(resolve, PICTURES_WAIT_MS))]);
    if (work.coming !== own || work.draft !== loading) return;
    work.coming = null;
    show();
    void suggester.suggest(loading);
    prefetch.start();
  }

  /** @param {number} wanted */
  function showStep(wanted) {
    work.step = wanted;
    show();
  }

  // -- boxes on the image

  /** @param {number} index */
  function onImageSelect(index) {
    const item = work.items[index];
    work.selected = item ?? null;
    if (item && item !== work.draft?.item) open(item);
  }

  /**
   * @param {Box2D[]} boxes
   * @param {EditKind} why
   * @param {number} index
   * @param {number} actions
   */
  function onImageChange(boxes, why, index, actions) {
    app.effort.action(actions);
    if (index >= work.items.length && why !== "draw")
      takeGuess(openGuesses(work)[index - work.items.length].item, boxes[index]);
    else if (why === "draw") add(makeItem(plainBox(boxes[index])));
    else if (why === "delete") removeItem(work.items[index]);
    else changeImageBox(work.items[index], plainBox(boxes[index]));
  }

  /** @param {Item} item */
  function add(item) {
    work.items = [...work.items, item];
    work.selected = item;
    if (item.boxes.some(Boolean)) {
      // its views may belong to another box on the image
      changeImageBox(item, item.image_box);
      return;
    }
    open(item);
    save(item);
  }

  /**
   * @param {Item} item
   * @param {Box2D} box
   */
  function takeGuess(item, box) {
    work.notSaved = work.notSaved.filter((known) => known !== item);
    add({ ...item, uid: null, stored: null, image_box: { ...plainBox(box), score: 1 } });
  }

  /**
   * @param {Item} item
   * @param {Box2D} box
   */
  function changeImageBox(item, box) {
    item.image_box = box;
    if (work.draft?.item !== item) begin(item);
    const isWaiting = moves.isWaiting(item);
    const isDrawn = item.boxes.some(Boolean) || item.uid;
    if (isDrawn && !isWaiting && work.draft) moves.start(work.draft);
    work.loaded = loadSteps();
    if (isWaiting) void saver.retry();
    else if (isDrawn) saver.save({ item, make: () => followed(item) });
    else save(item);
    show();
  }

  /**
   * The change of an object whose image box was moved, once its boxes are on the new views; null if it is gone.
   *
   * @param {Item} item
   */
  async function followed(item) {
    const isThere = await moves.settle(item, (draft) => {
      if (work.draft === draft) work.loaded = loadSteps();
      else void moves.load(draft);
    });
    return isThere ? changeOf(item) : null;
  }

  // -- boxes on the views

  /**
   * @param {number} index
   * @param {Box2D} box
   * @param {number} actions
   */
  function setViewBox(index, box, actions) {
    app.effort.action(actions);
    const { draft } = work;
    if (!draft) return;
    const { item } = draft;
    item.boxes[index] = { ...plainBox(box), label: item.image_box.label, score: 1 };
    draft.suggestions[index] = null;
    draft.edits[index] += 1;
    const isWholeStep = item.boxes[index - (index % 2)] && item.boxes[index - (index % 2) + 1];
    if (index < 2 && isWholeStep) {
      // the views of the second step follow from these; boxes on the old ones become guesses on the new ones
      demoteSecondStep(draft);
      work.loaded = loadSteps();
    }
    save(item);
    if (index >= 2 && isWholeStep) image.select(-1);
    show();
  }

  /**
   * @param {number} index
   * @param {number} actions
   */
  function clearViewBox(index, actions) {
    app.effort.action(actions);
    const { draft } = work;
    if (!draft) return;
    draft.item.boxes[index] = null;
    draft.edits[index] += 1;
    if (index < 2) demoteSecondStep(draft);
    save(draft.item);
    work.step = openStep(draft.item);
    show();
  }

  // -- the object as a whole

  /** @param {string} name */
  function pickClass(name) {
    work.label = name;
    const item = work.draft?.item;
    if (item && !work.isReadonly && (work.selected === item || !isFinished(item)) && item.image_box.label !== name) {
      app.effort.action();
      item.image_box = { ...item.image_box, label: name };
      item.boxes = item.boxes.map((box) => box && { ...box, label: name });
      save(item);
      // suggestions that have been requested are of the former class
      if (!work.coming && work.draft) void suggester.suggest(work.draft);
    }
    show();
  }

  /** @param {Item} item */
  function remove(item) {
    app.effort.action();
    removeItem(item);
  }

  /** @param {Item} item */
  function removeItem(item) {
    work.items = work.items.filter((other) => other !== item);
    moves.forget(item);
    if (work.draft?.item === item) close();
    saver.save(removal(item, kind));
    show();
  }

  /**
   * Saves an object as it is now; while it waits for its views, it is saved when they are loaded.
   *
   * @param {Item} item
   */
  function save(item) {
    if (!moves.isWaiting(item)) saver.save(changeOf(item));
  }

  /** @param {Item} item */
  function changeOf(item) {
    const outline = work.draft?.item === item ? work.draft.outline : null;
    return objectChange(item, { after: work.loaded, outline, kind });
  }

  /**
   * The others' version was kept. The dropped change stays visible; a click or Enter saves it.
   *
   * @param {FrameChange | LaterChange} options
   */
  function onDropped({ item }) {
    if (!item) return;
    // boxes that have not been transferred yet are not on any view of the moved object
    const boxes = moves.isWaiting(item) ? [] : item.boxes;
    moves.forget(item);
    const theirs = work.items.find((known) => sameBox(known.image_box, item.image_box));
    if (theirs) {
      if (work.draft?.item !== theirs) open(theirs);
      const { draft } = work;
      if (draft)
        draft.suggestions = draft.suggestions.map((guess, i) => (theirs.boxes[i] ? null : (boxes[i] ?? guess)));
    } else {
      work.notSaved = [...work.notSaved.filter((known) => !sameBox(known.image_box, item.image_box)), item];
    }
    show();
  }

  /** @param {number} direction */
  function cycle(direction) {
    if (!work.items.length) return false;
    const index = work.draft ? work.items.indexOf(work.draft.item) + direction : direction > 0 ? 0 : -1;
    const item = work.items.at(index % work.items.length);
    if (item) open(item);
    return true;
  }

  return {
    open,
    openLabel,
    close,
    showStep,
    onImageSelect,
    onImageChange,
    setViewBox,
    clearViewBox,
    pickClass,
    remove,
    onDropped,
    cycle,
  };
}
