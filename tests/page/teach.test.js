// Drawing on the pseudo-views without its display: an object's boxes on its views, and the changes that are saved one after the other.

import assert from "node:assert/strict";
import { test } from "node:test";
import { ApiError } from "../../web_assets/js/errors.js";
import {
  carryBox,
  createStepLoader,
  demoteSecondStep,
  drawnObject,
  makeDraft,
  takeSteps,
} from "../../web_assets/js/annotate/draft.js";
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

test("a box is carried to a view of the same axes exactly, to a turned one as a guess, and to another one not", () => {
  const moved = carryBox(box(10, 10, 30, 40), view("a"), view("b", [0.05, -0.1]));
  assert.deepEqual(moved, { box: box(5, 20, 25, 50), isExact: true });
  const [c, s] = [Math.cos(0.1), Math.sin(0.1)];
  const turned = [
    [c, 0, s],
    [0, 1, 0],
    [-s, 0, c],
  ];
  assert.equal(carryBox(box(10, 10, 30, 40), view("a"), view("b", [0, 0], turned)).isExact, false);
  assert.equal(carryBox(box(10, 10, 30, 40), view("a"), view("b", [0, 0], SIDE_AXES)), null);
  assert.equal(carryBox(box(10, 10, 30, 40), view("a"), view("b", [2, 0])), null, "it would lie outside");
});

test("boxes follow new views; those of the second step become guesses once the first step lacks a box", () => {
  const draft = makeDraft(items.makeItem(box(0, 0, 9, 9)), 1);
  const first = [view("1"), view("2", [0, 0], SIDE_AXES)];
  takeSteps(draft, answer([{ views: first, suggested: [box(1, 1, 5, 5), null] }]));
  assert.deepEqual(draft.suggestions.map(Boolean), [true, false, false, false]);
  draft.item.boxes = [box(10, 10, 30, 40), box(10, 10, 30, 40), box(1, 1, 5, 5), null];
  draft.item.views[2] = view("3");
  const again = [view("4", [0.05, 0]), view("5", [0, 0], SIDE_AXES)];
  takeSteps(
    draft,
    answer([
      { views: again, suggested: [null, null] },
      { views: [view("6"), view("7")], suggested: [null, null] },
    ]),
  );
  assert.equal(draft.item.boxes[0].x_min, 5);
  assert.equal(draft.steps.length, 1, "the answer's second step followed from the old positions");
  demoteSecondStep(draft);
  assert.deepEqual([draft.item.boxes[2], draft.kept[2], draft.suggestions[2]], [null, true, box(1, 1, 5, 5)]);
  assert.deepEqual(drawnObject(draft).boxes.length, 2);
});

test("views are loaded again until they match the boxes, and a newer request replaces an older one", async () => {
  const draft = makeDraft(items.makeItem(box(0, 0, 9, 9)), 1);
  const answers = [held(), held(), held()];
  let asked = 0;
  const loader = createStepLoader(() => answers[asked++].promise);
  const [older, newer] = [loader.load(draft, false), loader.load(draft, false)];
  draft.item.boxes[0] = box(1, 1, 5, 5); // drawn before the answer
  for (const each of answers) each.resolve(answer([{ views: [view("1"), view("2")], suggested: [null, null] }]));
  assert.deepEqual(await Promise.all([older, newer]), [false, true]);
  assert.equal(asked, 3);
  assert.equal(draft.isLoading, false);
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

test("a box whose class gets a new name while it is refused is sent again with that name", async () => {
  const sent = [];
  const refusal = held();
  const { saver } = saverOf(async (_, { revision, image_boxes, object }) => {
    sent.push([image_boxes[0].label, object.image_box.label]);
    if (sent.length === 1) await refusal.promise;
    return frameState(revision + 1);
  });
  const draft = makeDraft(items.makeItem(box(0, 0, 9, 9)), 1);
  saver.save(objectChange(draft, { after: Promise.resolve(), kind: () => "box", onDrawn() {} }));
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
