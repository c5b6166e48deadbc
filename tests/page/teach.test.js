// Drawing on the pseudo-views without its display: an object's boxes on its views, and the changes that are saved one after the other.

import assert from "node:assert/strict";
import { test } from "node:test";
import { ApiError } from "../../web_assets/js/errors.js";
import { drawnObject, filledBoxes, makeDraft, suggestionsOf, takeSteps } from "../../web_assets/js/annotate/draft.js";
import { objectChange } from "../../web_assets/js/annotate/objects.js";
import * as items from "../../web_assets/js/annotate/items.js";
import { createSaver, createSender } from "../../web_assets/js/annotate/saver.js";
import { fakeApp, frameState, held, settled } from "./fakes.js";

const box = (left, top, right, bottom, more = {}) => {
  return { label: "person", x_min: left, y_min: top, x_max: right, y_max: bottom, score: 1, ...more };
};
const AXES = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];
const SIDE_AXES = [
  [0, 0, -1],
  [0, 1, 0],
  [1, 0, 0],
];
const view = (id, origin = [0, 0], axes = AXES) => ({
  id,
  axes,
  origin_m: origin,
  metres_per_px: 0.01,
  width: 100,
  height: 100,
});
const answer = (steps) => ({
  steps,
  outline: null,
  stop: null,
  detector: "none",
  measured_by: null,
  suggestion: null,
});

// -- an object's boxes

test("a stored box on the side view alone is on the side view again", () => {
  const front = items.makeItem(box(0, 0, 9, 9), [[view("f"), box(1, 1, 5, 5)]]);
  assert.deepEqual(front.boxes.map(Boolean), [true, false, false, false]);
  const side = items.makeItem(box(0, 0, 9, 9), [[view("s", [0, 0], SIDE_AXES), box(1, 1, 5, 5)]]);
  assert.deepEqual(side.boxes.map(Boolean), [false, true, false, false]);
  assert.equal(items.progressOf(side), 2);
});

test("the image boxes are exchanged one by one", () => {
  const [a, b, c] = [box(0, 0, 5, 5), box(10, 0, 15, 5), box(20, 0, 25, 5)];
  assert.deepEqual(items.exchanged([a], null, b), [a, b]);
  assert.deepEqual(items.exchanged([a, b], a, c), [c, b]);
  assert.deepEqual(items.exchanged([a, b], a, null), [b]);
  assert.deepEqual(items.exchanged([b], a, c), [b, c], "others have removed it");
  assert.equal(items.overlap(a, box(2.5, 0, 7.5, 5)), 1 / 3);
  assert.equal(items.overlap(a, { ...a, label: "chair" }), 0);
});

test("an object has the boxes as they lie on its new views, and suggestions where none is drawn", () => {
  const draft = makeDraft(items.makeItem(box(0, 0, 9, 9)), 1);
  const first = [view("1"), view("2", [0, 0], SIDE_AXES)];
  takeSteps(draft, answer([{ views: first, drawn: [null, null], suggested: [box(1, 1, 5, 5), null] }]));
  assert.deepEqual(suggestionsOf(draft).map(Boolean), [true, false, false, false]);
  assert.deepEqual(filledBoxes(draft)[0], box(1, 1, 5, 5));
  draft.item.boxes = [box(10, 10, 30, 40), box(10, 10, 30, 40), box(1, 1, 5, 5), null];
  draft.item.views[2] = view("3", [0.2, 0]);
  assert.deepEqual(
    drawnObject(draft.item).planes.map((plane) => plane?.origin_m ?? null),
    [[0, 0], [0, 0], [0.2, 0], null],
  );
  const again = [view("4", [0.05, 0]), view("5", [0, 0], SIDE_AXES)];
  takeSteps(draft, answer([{ views: again, drawn: [box(5, 10, 25, 40), null], suggested: [null, box(2, 2, 6, 6)] }]));
  assert.deepEqual(
    draft.item.boxes,
    [box(5, 10, 25, 40), null, box(1, 1, 5, 5), null],
    "the third waits for its view",
  );
  assert.deepEqual(suggestionsOf(draft).map(Boolean), [false, true, false, false]);
  assert.deepEqual(
    drawnObject(draft.item).planes.map((plane) => plane?.origin_m ?? null),
    [[0.05, 0], null, [0.2, 0], null],
  );
});

// -- saving

const plain = (kind) => ({ path: ["changes"], body: () => ({ changes: [{ kind }] }) });

function saverOf(change) {
  const app = fakeApp({ change, state: { frame: frameState(3) } });
  app.frames.take = (state) => (app.state.frame = state);
  const busy = [];
  const saver = createSaver(
    app,
    createSender(app, () => {}),
    { onSaved() {}, onDropped() {}, onBusy: (is) => busy.push(is) },
  );
  return { app, saver, busy };
}

test("changes are sent one after the other, each with the revision that the one before gave", async () => {
  const sent = [];
  const { saver, busy } = saverOf(async (path, { revision, changes }) => {
    sent.push([path, revision, changes[0].kind]);
    return frameState(revision + 1);
  });
  saver.save(plain("finalise"));
  saver.save(plain("image_boxes"));
  assert.equal(saver.isBusy, true);
  await saver.idle();
  assert.deepEqual(sent, [
    ["frames/1/changes", 3, "finalise"],
    ["frames/1/changes", 4, "image_boxes"],
  ]);
  assert.deepEqual([saver.isBusy, busy], [false, [true, false]]);
});

test("what could not be sent waits, with the problem, until it is tried again or discarded", async () => {
  let isRefused = true;
  const { saver } = saverOf(async (_, { revision }) => {
    if (isRefused) throw new ApiError(0, "", "no answer");
    return frameState(revision + 1);
  });
  saver.save(plain("finalise"));
  await saver.idle();
  assert.deepEqual([saver.problem.message, saver.waiting], ["no answer", 1]);
  isRefused = false;
  await saver.retry();
  assert.deepEqual([saver.problem, saver.waiting], [null, 0]);
  isRefused = true;
  saver.save(plain("reopen"));
  await saver.idle();
  saver.discard();
  assert.deepEqual([saver.problem, saver.isBusy], [null, false]);
});

test("what is saved after others were discarded is sent, also while one of them is on its way", async () => {
  const [answer, sent] = [held(), []];
  const { saver } = saverOf(async (_, { revision, changes }) => {
    sent.push(changes[0].kind);
    if (sent.length === 1) await answer.promise;
    return frameState(revision + 1);
  });
  saver.save(plain("finalise"));
  await settled();
  saver.discard();
  saver.save(plain("reopen"));
  answer.resolve();
  await saver.idle();
  assert.deepEqual(sent, ["finalise", "reopen"]);
});

test("a box whose class gets a new name while it is refused is sent again with that name", async () => {
  const sent = [];
  const refusal = held();
  const { saver } = saverOf(async (_, { revision, image_boxes, object }) => {
    sent.push([image_boxes[0].label, object.image_box.label]);
    if (sent.length === 1) await refusal.promise;
    return frameState(revision + 1);
  });
  const draft = makeDraft(items.makeItem(box(0, 0, 9, 9)), 1);
  saver.save(objectChange(draft, { kind: () => "box", onDrawn() {} }));
  await settled();
  saver.relabel({ person: "human" });
  refusal.reject(new ApiError(422, "ConfigError", "'person' is not a class"));
  await saver.idle();
  assert.deepEqual(sent, [
    ["person", "person"],
    ["human", "human"],
  ]);
  assert.equal(saver.problem, null);
});
