/** What a drag means for the object that is drawn: its views, its boxes, its class, and what of it is saved. */

import { objectChange, removal } from "./changes.js";
import { isFinished } from "./display.js";
import { demoteSecondStep, makeDraft } from "./draft.js";
import { makeItem, openStep, plainBox, sameBox } from "./items.js";
import { createMoves } from "./moves.js";
import { openGuesses } from "./work.js";

/** A picture that does not come holds up neither what is saved nor what is suggested. */
const PICTURES_WAIT_MS = 400;

/** What is there now is on its way to the screen: a task after the next frame's callbacks runs after its painting. */
function painted() {
  return new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
}

/** @param {object} parts {saver, loader, suggester, prefetch, image, views, show}. */
export function createObjects(app, work, parts) {
  const { saver, loader, suggester, prefetch, image, views, show } = parts;
  const kind = () => work.kind;
  const moves = createMoves(loader);

  /** Makes an object the current one and fetches its views. */
  function open(item) {
    begin(item);
    work.loaded = loadSteps();
    show();
  }

  function begin(item) {
    moves.leave(work.draft);
    work.draft = moves.draftOf(item) ?? makeDraft(item, work.frame_shown);
    work.step = openStep(item);
    work.label = item.image_box.label;
  }

  function openLabel(uid) {
    const item = work.items.find((known) => known.uid === uid);
    if (item) open(item);
  }

  /** No object is the current one. */
  function close() {
    moves.leave(work.draft);
    suggester.stop();
    work.draft = null;
  }

  /** The current object's views, then all that can wait for them: saving, the 3D view, suggestions, reading ahead. */
  async function loadSteps() {
    const loading = work.draft;
    const { item } = loading;
    const own = (work.coming = {});
    suggester.stop();
    prefetch.stop();
    try {
      const is_newest = await moves.load(loading);
      if (!is_newest || work.draft !== loading) return;
      if (item.boxes.every(Boolean)) loading.outline = null;
    } catch (error) {
      loading.stop = error.message;
      // nobody draws on the views of the box that was there before
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

  function showStep(wanted) {
    work.step = wanted;
    show();
  }

  // -- boxes on the image

  function onImageSelect(index) {
    const item = work.items[index];
    work.selected = item ?? null;
    if (item && item !== work.draft?.item) open(item);
  }

  function onImageChange(boxes, why, index, actions) {
    app.effort.action(actions);
    if (index >= work.items.length && why !== "draw") takeGuess(openGuesses(work)[index - work.items.length].item, boxes[index]);
    else if (why === "draw") add(makeItem(plainBox(boxes[index])));
    else if (why === "delete") removeItem(work.items[index]);
    else changeImageBox(work.items[index], plainBox(boxes[index]));
  }

  function add(item) {
    work.items = [...work.items, item];
    work.selected = item;
    if (item.boxes.some(Boolean)) {
      // its views may be those of another box on the image
      changeImageBox(item, item.image_box);
      return;
    }
    open(item);
    save(item);
  }

  function takeGuess(item, image_box) {
    work.not_saved = work.not_saved.filter((known) => known !== item);
    add({ ...item, uid: null, stored: null, image_box: { ...plainBox(image_box), score: 1 } });
  }

  function changeImageBox(item, image_box) {
    item.image_box = image_box;
    if (work.draft?.item !== item) begin(item);
    const is_waiting = moves.isWaiting(item);
    const is_drawn = item.boxes.some(Boolean) || item.uid;
    if (is_drawn && !is_waiting) moves.start(work.draft);
    work.loaded = loadSteps();
    if (is_waiting) void saver.retry();
    else if (is_drawn) saver.save({ item, make: () => followed(item) });
    else save(item);
    show();
  }

  /** The change of an object whose image box was moved, once its boxes lie on the new views; null where it is gone. */
  async function followed(item) {
    const is_there = await moves.settle(item, (draft) => {
      if (work.draft === draft) work.loaded = loadSteps();
      else void moves.load(draft);
    });
    return is_there ? changeOf(item) : null;
  }

  // -- boxes on the views

  function setViewBox(index, box, why, actions) {
    app.effort.action(actions);
    const { draft } = work;
    const { item } = draft;
    item.boxes[index] = { ...plainBox(box), label: item.image_box.label, score: 1 };
    draft.suggestions[index] = null;
    draft.edits[index] += 1;
    const is_whole_step = item.boxes[index - (index % 2)] && item.boxes[index - (index % 2) + 1];
    if (index < 2 && is_whole_step) {
      // The second step's views follow from these; what was drawn on the old ones becomes a guess on the new.
      demoteSecondStep(draft);
      work.loaded = loadSteps();
    }
    save(item);
    if (index >= 2 && is_whole_step) image.select(-1);
    show();
  }

  function clearViewBox(index, actions) {
    app.effort.action(actions);
    const { draft } = work;
    draft.item.boxes[index] = null;
    draft.edits[index] += 1;
    if (index < 2) demoteSecondStep(draft);
    save(draft.item);
    work.step = openStep(draft.item);
    show();
  }

  // -- the object as a whole

  function pickClass(name) {
    work.label = name;
    const item = work.draft?.item;
    if (item && !work.is_readonly && (work.selected === item || !isFinished(item)) && item.image_box.label !== name) {
      app.effort.action();
      item.image_box = { ...item.image_box, label: name };
      item.boxes = item.boxes.map((box) => box && { ...box, label: name });
      save(item);
      // What is on its way is of the former class.
      if (!work.coming) void suggester.suggest(work.draft);
    }
    show();
  }

  function remove(item) {
    app.effort.action();
    removeItem(item);
  }

  function removeItem(item) {
    work.items = work.items.filter((other) => other !== item);
    moves.forget(item);
    if (work.draft?.item === item) close();
    saver.save(removal(item, kind));
    show();
  }

  /** Saves an object as it is now; one that waits for its views, as it is when they are there. */
  function save(item) {
    if (!moves.isWaiting(item)) saver.save(changeOf(item));
  }

  function changeOf(item) {
    const outline = work.draft?.item === item ? work.draft.outline : null;
    return objectChange(item, { after: work.loaded, outline, kind });
  }

  /** The others' version was taken: what was drawn here stays in sight, and a click (or Enter) saves it after all. */
  function onDropped({ item }) {
    if (!item) return;
    // boxes that have not followed theirs on the image lie on no view of it
    const boxes = moves.isWaiting(item) ? [] : item.boxes;
    moves.forget(item);
    const theirs = work.items.find((known) => sameBox(known.image_box, item.image_box));
    if (theirs) {
      if (work.draft?.item !== theirs) open(theirs);
      const { draft } = work;
      draft.suggestions = draft.suggestions.map((guess, i) => (theirs.boxes[i] ? null : (boxes[i] ?? guess)));
    } else {
      work.not_saved = [...work.not_saved.filter((known) => !sameBox(known.image_box, item.image_box)), item];
    }
    show();
  }

  function cycle(direction) {
    if (!work.items.length) return false;
    const index = work.draft ? work.items.indexOf(work.draft.item) + direction : direction > 0 ? 0 : -1;
    open(work.items.at(index % work.items.length));
    return true;
  }

  return { open, openLabel, close, showStep, onImageSelect, onImageChange, setViewBox, clearViewBox, pickClass, remove, onDropped, cycle };
}
