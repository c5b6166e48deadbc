// Keys of Annotate that go on before a decision is saved, and what is offered to the operator.

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { createCommands } from "../../web_assets/js/annotate/commands.js";
import { createDesk } from "../../web_assets/js/annotate/desk.js";
import { createOpening } from "../../web_assets/js/annotate/opening.js";
import { createQueue } from "../../web_assets/js/annotate/queue.js";
import { ApiError } from "../../web_assets/js/errors.js";
import { createFrameState } from "../../web_assets/js/frame_state.js";
import { parseHash } from "../../web_assets/js/router.js";
import { BOX, fakeApp, frameState, freshStorage, held, LONGER, settled } from "./fakes.js";

beforeEach(() => {
  freshStorage();
});

/** Annotate in its queue, on the first of frames 1, 2, ..., which have a proposal each: "a", "b", ...; all are known. */
async function reviewOf(uids, change, more = {}) {
  const values = new Map();
  globalThis.sessionStorage = {
    setItem: (name, value) => values.set(name, value),
    getItem: (name) => values.get(name),
    removeItem: (name) => values.delete(name),
  };
  const label = { label: "person", box: BOX, track_id: null, state: "proposed", better_in: null, doubt: 0, ...more };
  const stateOf = (id, revision = 3, state = "proposed") =>
    frameState(revision, [{ ...label, uid: uids[id - 1], state }], id);
  const get = async (path) => {
    if (!path.startsWith("queue")) return stateOf(Number(path.match(/\d+/)[0]));
    return path === "queue/sources"
      ? {}
      : { items: uids.map((uid, i) => ({ uid, frame: i + 1 })), remaining: uids.length };
  };
  const app = fakeApp({ get, change: (path, body) => change(path, body, stateOf) });
  app.frames = createFrameState(app);
  Object.assign(app, {
    loadFrame: (id, bestFor) => app.frames.open(id, bestFor),
    mayLeave: async () => true,
    go: (hash) => (app.address = hash),
  });
  app.state.route = parseHash("#/room/annotate");
  app.state.project = { name: "room" };
  const [desk, queue] = [createDesk(app), createQueue(app, () => {})];
  const opening = createOpening(app, { desk, queue, onLoading() {}, onProblem() {} });
  app.state.on("frame", (frame) => {
    if (!frame) return;
    desk.settle();
    queue.settle(frame);
  });
  const teach = { accept: () => false, unsaved: null };
  const at = { app, desk, queue, opening, teach, image: { isBusy: false }, parts: { root: { isConnected: true } } };
  const { keys } = createCommands({ ...at, areas: {}, picker: { label: "person" } });
  await opening.begin();
  for (const [i, uid] of uids.entries()) await app.frames.prepare(i + 1, uid);
  return { app, desk, queue, keys, press: () => keys.accept(""), stateOf };
}

test("the queue's next box is there before the one before is saved, and each press means the box on the screen", async () => {
  const [answers, sent] = [[held(), held()], []];
  const { app, queue, press, stateOf } = await reviewOf(["a", "b", "c"], (path, { revision, changes }) => {
    sent.push([path, revision, changes[0].uid]);
    return answers[sent.length - 1].promise;
  });
  const first = press();
  await settled();
  assert.deepEqual([app.state.frame.frame.id, app.address], [2, "#/room/annotate/2"]);
  const second = press();
  await settled();
  assert.equal(app.state.frame.frame.id, 3);
  assert.deepEqual(sent, [["frames/1/changes", 3, "a"]]);
  answers[0].resolve(stateOf(1, 4, "accepted"));
  answers[1].resolve(stateOf(2, 4, "accepted"));
  await Promise.all([first, second]);
  assert.deepEqual(sent[1], ["frames/2/changes", 3, "b"]);
  assert.deepEqual([queue.items.map(({ uid }) => uid), queue.remaining], [["c"], 1]);
});

test("what is refused is shown again, the first one if there are several, and all are in the queue", async () => {
  const [answer, sent] = [held(), []];
  const { app, queue, press } = await reviewOf(["a", "b", "c"], (_, { changes }) => {
    sent.push(changes[0].uid);
    return answer.promise;
  });
  const presses = [press(), settled().then(press)];
  await settled();
  await settled();
  assert.equal(app.state.frame.frame.id, 3);
  assert.deepEqual(
    queue.items.map(({ uid }) => uid),
    ["c"],
  );
  answer.reject(new ApiError(0, "", "The server does not respond"));
  await Promise.all(presses);
  assert.deepEqual([sent, app.state.frame.frame.id, app.address], [["a", "b"], 1, "#/room/annotate/1"]);
  assert.deepEqual(app.told, Array(2).fill("The server does not respond"));
  assert.deepEqual(queue.items.map(({ uid }) => uid).sort(), ["a", "b", "c"]);
  assert.equal(queue.remaining, 3);
});

test("a decision is based on what was on the screen, however many frames were opened since", async () => {
  const [answers, sent] = [[held(), held()], []];
  const { app, press, stateOf } = await reviewOf(["a", "b", "c"], (_, { revision }) => {
    sent.push(revision);
    return answers[sent.length - 1].promise;
  });
  const presses = [press(), settled().then(press)];
  await settled();
  await settled();
  app.frames.miss();
  app.api.get = async () => stateOf(2, 9);
  answers[0].resolve(stateOf(1, 4, "accepted"));
  answers[1].resolve(stateOf(2, 4, "accepted"));
  await Promise.all(presses);
  assert.deepEqual(sent, [3, 3], "others have changed the second frame, so that the server refuses this");
});

test("what other frames show, too, is saved before one of them is opened, and that one is read anew", async () => {
  const [answer, asked] = [held(), []];
  const { app, desk, press, stateOf } = await reviewOf(["a", "b"], () => answer.promise, { still: true });
  app.api.get = async (path) => asked.push(path) && stateOf(2, 4);
  const pressed = press();
  await settled();
  assert.equal(app.state.frame.frame.id, 1);
  answer.resolve({ ...stateOf(1, 4, "accepted"), moved: 0 });
  await pressed;
  assert.equal(asked[0], "frames/2?best_for=b");
  const { id, revision } = app.state.frame.frame;
  assert.deepEqual([id, revision, desk.uid], [2, 4, "b"]);
});

test("a box of what nobody labelled makes place for the next one, unless it was corrected", async () => {
  const { app, desk, keys } = await reviewOf(["a"], () => {});
  let distance = 0;
  app.viewport = { showUnlabelled: () => false, look() {} };
  app.api.post = async (_, { beyond }) => {
    assert.equal(beyond, distance);
    distance += 1;
    return { box: BOX, outline: [], label: null, note: null, too_few_points: false, distance };
  };
  const added = () => desk.labels().flatMap(({ uid, isNew }) => (isNew ? uid : []));
  await keys.unlabelled("");
  await keys.unlabelled("");
  assert.deepEqual(added(), ["new-2"]);
  await desk.edit({ box: LONGER });
  await keys.unlabelled("");
  assert.deepEqual(added(), ["new-2", "new-3"]);
});
