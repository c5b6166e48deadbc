// The state of the page without its display: the open frame, the queue, unsaved boxes, and what is loaded ahead.

import assert from "node:assert/strict";
import { beforeEach, mock, test } from "node:test";
import { ApiError } from "../../web_assets/js/errors.js";
import { createFrameState } from "../../web_assets/js/frame_state.js";
import { readAreas } from "../../web_assets/js/annotate/areas.js";
import { createDesk } from "../../web_assets/js/annotate/desk.js";
import { createOpening } from "../../web_assets/js/annotate/opening.js";
import { createPreload } from "../../web_assets/js/annotate/preload.js";
import { createQueue } from "../../web_assets/js/annotate/queue.js";
import { sameBox } from "../../web_assets/js/box3d.js";
import { copiedText } from "../../web_assets/js/annotate/tracks.js";
import { makeHash, parseHash } from "../../web_assets/js/router.js";
import { BOX, fakeApp, frameState, freshStorage, held, LONGER, settled } from "./fakes.js";

beforeEach(() => {
  freshStorage();
});

// -- the open frame

test("an older answer never replaces a newer state", async () => {
  let answer = frameState(3);
  const app = fakeApp({ get: async () => answer });
  const frames = createFrameState(app);
  const isNow = (revision, isBehind) =>
    assert.deepEqual([app.state.frame.frame.revision, frames.isBehind], [revision, isBehind]);

  await frames.open(1);
  isNow(3, false);
  assert.equal(frames.take(frameState(2)), false);
  assert.equal(frames.take(frameState(5, [], 1, "another")), false, "of the same number in another project");
  isNow(3, false);
  assert.equal(frames.take(frameState(5)), true);
  frames.hear({ frame: 1, revision: 6 });
  frames.hear({ frame: 2, revision: 9 });
  isNow(5, true);
  answer = frameState(6);
  await frames.refresh(() => false);
  isNow(5, true);
  await frames.refresh();
  isNow(6, false);
  answer = frameState(4);
  await frames.open(1);
  isNow(6, false);
  frames.miss();
  isNow(6, true);
  answer = frameState(6);
  await frames.refresh();
  isNow(6, false);
  // read again, since an event has named a newer revision
  const later = [frameState(8, [], 2), frameState(9, [], 2)];
  app.api.get = async () => later.shift();
  await frames.open(2);
  isNow(9, false);
});

test("a frame that could not be read again is still behind", async () => {
  const app = fakeApp({ get: async () => frameState(1) });
  const frames = createFrameState(app);
  await frames.open(1);
  frames.miss();
  app.api.get = async () => Promise.reject(new ApiError(0, "", "no answer"));
  await assert.rejects(frames.refresh());
  assert.equal(frames.isBehind, true);
});

test("what is missed while a frame is read is read again, and what was asked for before is not kept", async () => {
  const answers = [];
  const get = () => answers.push(held()) && answers.at(-1).promise;
  const app = fakeApp({ get });
  const frames = createFrameState(app);
  const opened = frames.open(1);
  frames.miss();
  answers[0].resolve(frameState(3));
  await opened;
  assert.equal(frames.isBehind, true);
  const refreshed = frames.refresh();
  frames.miss();
  answers[1].resolve(frameState(3));
  await refreshed;
  assert.equal(frames.isBehind, true);
  // another frame is opened, as it was before, while this one is read again
  const other = frames.open(3, null);
  frames.miss();
  const late = frames.refresh();
  answers[2].resolve(frameState(3, [], 3));
  await other;
  answers[3].resolve(frameState(3));
  await late;
  assert.equal(frames.isBehind, true);
  const prepared = frames.prepare(2, null);
  frames.giveUp();
  answers[4].resolve(frameState(3, [], 2));
  await prepared;
  void frames.open(2, null);
  assert.equal(answers.length, 6, "it may be older than what has changed it");
});

test("what was read ahead is opened at once, and is behind until it is read again", async () => {
  const asked = [];
  const app = fakeApp({ get: async (path) => asked.push(path) && frameState(3, [], 2) });
  const frames = createFrameState(app);
  await frames.prepare(2, "a");
  await frames.open(2, "b");
  assert.equal(asked.length, 2, "another label may be seen better by another camera");
  app.state.frame = frameState(1);
  await frames.prepare(2, null);
  asked.length = 0;
  await frames.open(2, null);
  assert.deepEqual([app.state.frame.frame.id, asked, frames.isBehind], [2, [], true]);
  await frames.refresh();
  assert.deepEqual([asked, frames.isBehind], [["frames/2"], false]);
  app.state.frame = frameState(1);
  await frames.prepare(2, null);
  frames.hear({ frame: 2, revision: 4 });
  asked.length = 0;
  await frames.open(2, null);
  assert.notEqual(asked.length, 0, "it has changed since");
  // a frame that was left is known, too, as it was saved later
  assert.equal(frames.take(frameState(5)), false);
  frames.take(frameState(4));
  assert.equal((await frames.of(1)).frame.revision, 5);
  frames.miss();
  asked.length = 0;
  await frames.open(1, null);
  assert.equal(asked[0], "frames/1", "messages about it may have been missed");
});

// -- the queue

const item = (uid, frame = 1) => ({ uid, frame });

function queueOf(items, remaining = items.length) {
  const asked = [];
  const answer = { items, remaining };
  const get = async (url) => {
    asked.push(url);
    return url.includes("sources") ? {} : answer;
  };
  const app = fakeApp({ get });
  const queue = createQueue(app, () => {});
  return { queue, asked, answer, app, reads: () => asked.filter((url) => !url.includes("sources")).length };
}

test("the next item is the one after this one, and at the end the first one that was left", async () => {
  const { queue } = queueOf(["a", "b", "c"].map((uid) => item(uid)));
  await queue.load();
  assert.equal(queue.after("a").uid, "b");
  assert.equal(queue.after("c").uid, "a");
  queue.visit("b");
  // "b" is accepted
  queue.settle(
    frameState(2, [
      { uid: "a", state: "proposed" },
      { uid: "c", state: "proposed" },
    ]),
  );
  assert.deepEqual([queue.items.map(({ uid }) => uid), queue.remaining], [["a", "c"], 2]);
  assert.equal(queue.after("b").uid, "c", "goes on from the same place");
});

test("items of other frames stay, and an undo brings its item back at once and reads the queue again", async () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  const { queue, reads } = queueOf([item("a"), item("b", 2)]);
  await queue.load();
  queue.settle(frameState(2, []));
  assert.deepEqual(
    queue.items.map(({ uid }) => uid),
    ["b"],
  );
  queue.settle(frameState(3, [{ uid: "a", state: "proposed" }]));
  assert.deepEqual([queue.items.map(({ uid }) => uid), queue.remaining], [["a", "b"], 2]);
  assert.equal(reads(), 1);
  mock.timers.tick(2000);
  assert.equal(reads(), 2);
  // the frames of a moment have the same labels
  const other = frameState(4, []);
  other.frame.cameras = { 1: 1, 2: 2 };
  queue.settle(other);
  assert.deepEqual(queue.items, []);
  mock.timers.reset();
});

test("the queue is read again while changes keep coming", async () => {
  // as when an object is followed: a frame changes several times a second
  mock.timers.enable({ apis: ["setTimeout"] });
  const { queue, reads } = queueOf([], 37);
  for (let i = 0; i < 5; i += 1) {
    mock.timers.tick(400);
    queue.reloadSoon();
  }
  mock.timers.tick(0);
  assert.equal(reads(), 1);
  queue.end();
  mock.timers.tick(5000);
  assert.equal(reads(), 1);
  mock.timers.reset();
});

test("a filter asks the server, and the order is kept in the browser", async () => {
  const kept = freshStorage({ "queue-order": "time" });
  const { queue, asked } = queueOf([]);
  assert.equal(queue.order, "time");
  await queue.choose({ order: "class", value: { attribute: "pose", value: "sitting" }, source: "theirs" });
  assert.equal(asked[0], "queue?order=class&attribute=pose&value=sitting&source=theirs");
  assert.equal(kept.get("queue-order"), "class");
  assert.equal(queue.isFiltered, true);
});

// -- boxes that are not saved yet

function deskOf(change) {
  const app = fakeApp({
    change,
    state: { frame: frameState(3, [{ uid: "a", label: "person", box: BOX, track_id: null }]) },
  });
  app.frames.take = (frame) => (app.state.frame = frame);
  const desk = createDesk(app);
  desk.settle();
  desk.select("a");
  return { app, desk };
}

test("a new box is stored once, even if it is accepted again before the answer", async () => {
  const [answer, sent] = [held(), []];
  const { desk } = deskOf((_, { changes }) => {
    sent.push(...changes.map(({ kind }) => kind));
    return answer.promise;
  });
  desk.add({ label: "person", box: BOX, image_box: {} });
  const { uid } = desk;
  const decisions = [desk.decide("accept", uid), desk.decide("accept", uid)];
  answer.resolve(frameState(4, [{ uid: "a" }, { uid: "stored" }]));
  await Promise.all(decisions);
  assert.deepEqual(sent, ["create"]);
  assert.deepEqual(
    desk.labels().map((label) => label.uid),
    ["a", "stored"],
  );
  assert.equal(desk.uid, "stored");
});

test("a new box stays while the cameras of its moment are looked through, and is where each of them sees it", async () => {
  const sent = [];
  const { app, desk } = deskOf(async (_, { changes }) => sent.push(...changes) && { ...app.state.frame, moved: 0 });
  const open = (id, matrix, cameras = { 1: 1, 2: 2 }) => {
    const state = frameState(3, [], id);
    Object.assign(state.frame, { cameras, T_camera_cloud: matrix });
    app.state.frame = state;
    desk.settle();
  };
  // the second camera looks to the left from 2 m behind
  const left = [
    [0, 0, 1, 0],
    [0, 1, 0, 0],
    [-1, 0, 0, 2],
    [0, 0, 0, 1],
  ];
  open(1, null);
  desk.add({ label: "person", box: BOX, image_box: { x_min: 1 } });
  const { uid } = desk;
  open(2, left);
  desk.select(uid);
  assert.deepEqual(desk.shown.box.center, [3, 0, 2]);
  assert.equal(desk.imageBox(uid), null, "it is on the other image");
  open(1, null);
  assert.ok(sameBox(desk.labels()[0].box, BOX));
  assert.deepEqual(desk.imageBox(uid), { x_min: 1 });
  open(2, left);
  await desk.decide("accept", uid);
  assert.deepEqual([sent[0].box.center, sent[0].image_box], [[3, 0, 2], null]);
  desk.add({ label: "person", box: BOX, image_box: null });
  open(3, null, { 1: 3 });
  assert.deepEqual(desk.labels(), [], "another moment");
});

test("a draft that could not be saved is kept with its reason until it is saved or reverted", async () => {
  let isRefused = true;
  const { app, desk } = deskOf(async (_, { changes: [{ box }] }) => {
    if (isRefused) throw new ApiError(0, "", "The server does not respond");
    return { ...frameState(4, [{ uid: "a", label: "person", box, track_id: null }]), moved: 2 };
  });
  assert.equal(await desk.edit({ box: LONGER }), false);
  desk.select(null);
  assert.equal(desk.problemOf("a"), "The server does not respond");
  assert.match(desk.unsaved.text, /1 changed box\. The server does not respond/);
  isRefused = false;
  assert.equal(await desk.retry("a"), true);
  assert.equal(desk.unsaved, null);
  assert.deepEqual(app.state.frame.labels[0].box.size, LONGER.size);
  assert.equal(app.told.at(-1), "2 unreviewed boxes of the track moved along.");
  isRefused = true;
  desk.select("a");
  await desk.edit({ box: BOX });
  desk.revert();
  assert.equal(desk.unsaved, null);
});

test("a change for one frame only stays so when it is tried again, also after another box was selected", async () => {
  const [sent, labels] = [[], ["a", "b"].map((uid) => ({ uid, label: "person", box: BOX, track_id: 1, still: true }))];
  const { app, desk } = deskOf(async (_, { changes: [{ here }] }) => {
    sent.push(here);
    if (sent.length < 3) throw new ApiError(0, "", "The server does not respond");
    return { ...frameState(4, labels), moved: 0 };
  });
  app.state.frame = frameState(3, labels);
  desk.settle();
  desk.setHere(true);
  await desk.edit({ box: LONGER });
  desk.select("b");
  assert.equal(desk.isHere, false);
  await desk.retry("a");
  desk.select("a");
  assert.equal(desk.isHere, true);
  await desk.commit();
  assert.deepEqual(sent, [true, true, true]);
  // what is gone from all frames is told
  app.told.length = 0;
  await desk.decide("reject", "a");
  desk.select("b");
  await desk.decide("delete", "b");
  assert.deepEqual(sent.slice(3), [true, false]);
  assert.deepEqual(app.told, ["The object stands still: it was deleted in all frames."]);
});

test("the frame is changed by one request after the other, each with the newest revision", async () => {
  const [answers, sent] = [[held(), held()], []];
  const { desk } = deskOf((_, { revision, changes: [{ kind }] }) => {
    sent.push([revision, kind]);
    return answers[sent.length - 1].promise;
  });
  const labels = [{ uid: "a", label: "person", box: LONGER, track_id: null }];
  const both = [desk.edit({ box: LONGER }), desk.decide("accept", "a")];
  await settled();
  assert.deepEqual(sent, [[3, "edit"]]);
  answers[0].resolve(frameState(4, labels));
  await settled();
  assert.deepEqual(sent, [
    [3, "edit"],
    [4, "accept"],
  ]);
  answers[1].resolve(frameState(5, labels));
  assert.deepEqual(await Promise.all(both), [true, true]);
});

test("another track is no new review of the box, and a box that others have deleted is told", async () => {
  const sent = [];
  const { app, desk } = deskOf(async (_, { changes: [change] }) => {
    sent.push(change.kind);
    return frameState(4, [{ uid: "a", label: "person", box: BOX, track_id: 7 }]);
  });
  await desk.edit({ track_id: 7 });
  assert.deepEqual(sent, ["track"]);
  desk.preview({ box: LONGER });
  app.state.frame = frameState(5, []);
  desk.settle();
  assert.deepEqual(app.told, ["The box that you were changing was deleted elsewhere."]);
  assert.equal(desk.uid, null);
});

test("a draft of a box that others have changed meanwhile is sent as one of the older version, so that one is asked", async () => {
  const sent = [];
  const stored = (box, label = "person") => [{ uid: "a", label, box, track_id: null }];
  const { app, desk } = deskOf(async (_, { revision, changes: [{ box }] }) => {
    sent.push(revision);
    return frameState(revision + 1, stored(box));
  });
  const see = (revision, box, label) => {
    app.state.frame = frameState(revision, stored(box, label));
    desk.settle();
  };
  desk.preview({ box: LONGER });
  see(4, BOX);
  await desk.commit();
  assert.deepEqual(sent, [4], "another box was changed");
  desk.preview({ box: BOX });
  see(6, { ...BOX, size: [3, 1, 1] });
  await desk.commit();
  assert.deepEqual(sent, [4, 5], "this one was");
  // the page's own saving, and a class with another name, are no other version
  desk.preview({ box: LONGER });
  const first = desk.commit();
  desk.preview({ box: { ...BOX, size: [4, 1, 1] } });
  await Promise.all([first, desk.commit()]);
  assert.deepEqual(sent, [4, 5, 6, 7]);
  desk.preview({ box: BOX });
  desk.rename({ person: "human" });
  see(9, { ...BOX, size: [4, 1, 1] }, "human");
  await desk.commit();
  assert.equal(sent.at(-1), 9);
});

// -- other things that are waited for

test("nothing is loaded ahead while a sheet is open", async () => {
  globalThis.Image = class {
    decode = async () => {};
  };
  const { asked, preload, opening, shown } = preloadOf();
  const release = preload.hold();
  await preload.start();
  assert.deepEqual(asked, []);
  release();
  await settled();
  assert.deepEqual([asked, shown], [["frames/3", "frames/2?best_for=next"], [3]], "the frame beside is the likeliest");
  asked.length = 0;
  opening.inQueue = true;
  await preload.start();
  assert.deepEqual([asked, shown], [[], [3, 2]], "what is known is not read again");
});

function preloadOf() {
  const [asked, shown] = [[], []];
  const get = async (path) => {
    asked.push(path);
    return frameState(1, [], Number(path.match(/\d+/)[0]));
  };
  const viewport = { prepare: (frame) => shown.push(frame), idle: async () => {} };
  const app = { ...fakeApp({ get, state: { frame: frameState(1) } }), viewport };
  app.frames = createFrameState(app);
  const opening = { beside: 3, inQueue: false };
  const desk = { uid: "now", stored: () => null };
  const preload = createPreload(app, desk, { after: () => item("next", 2) }, opening);
  return { asked, shown, preload, opening };
}

test("places that the browser has kept badly are as if they were not set", () => {
  for (const [kept, read] of [
    ['{"main":"object","lists":"20.5%"}', { main: "object", lists: "20.5%" }],
    ['{"main":"attic","lists":"wide"}', {}],
    ["{", {}],
    ["null", {}],
  ]) {
    freshStorage({ areas: kept });
    assert.deepEqual(readAreas(), read);
  }
});

test("copies with few points are counted", () => {
  for (const [points, says] of [
    [[5], "1 box copied from the previous frame, to be reviewed."],
    [[0], "It holds no points here: move or delete it."],
    [[4], "It holds hardly any points here: move or delete it."],
    [[0, 9, 0], "2 copies hold no points here: move or delete them."],
    [[0, 9, 1], "2 copies hold hardly any points here: move or delete them."],
  ]) {
    const [text, kind] = copiedText(points.map((count) => ({ points: count })));
    assert.ok(text.endsWith(says), text);
    assert.equal(kind, says.startsWith("1 box") ? "good" : "warn");
  }
});

test("frames to draw on follow one another, and a frame is not its own next one", async () => {
  const items = [4, 2, 5].map((frame) => ({ frame, uid: null }));
  const queue = createQueue(fakeApp({ get: async () => ({ items, remaining: 3 }) }), () => {});
  await queue.choose({ order: "teach" });
  assert.deepEqual(
    [4, 2, 5, 9].map((frame) => queue.after(null, frame)?.frame),
    [2, 5, 4, 4],
  );
});

test("what was asked of the queue before another choice is not shown", async () => {
  const answers = [held(), held()];
  const asked = [];
  const get = (path) => answers[asked.push(path) - 1].promise;
  const queue = createQueue(fakeApp({ get }), () => {});
  const first = queue.load();
  const chosen = queue.choose({ source: "theirs" });
  assert.equal(queue.answered, 0);
  answers[1].resolve({ items: [{ uid: "b" }], remaining: 0 });
  await chosen;
  answers[0].resolve({ items: [{ uid: "a" }, { uid: "b" }], remaining: 0 });
  await first;
  assert.match(asked[1], /source=theirs/);
  assert.deepEqual(
    queue.items.map(({ uid }) => uid),
    ["b"],
  );
  assert.equal(queue.answered, 1);
});

test("a frame that cannot be read stays in the address, so that it is not asked for again and again", async () => {
  const values = new Map();
  globalThis.sessionStorage = {
    setItem: (name, value) => values.set(name, value),
    getItem: (name) => values.get(name),
  };
  const gone = [];
  const app = {
    ...fakeApp(),
    loadFrame: () => Promise.reject(new Error("no image")),
    go: (hash) => gone.push(hash),
  };
  const desk = { stored: () => undefined, flush: async () => {}, select() {}, labels: () => [] };
  const queue = { items: [item("a", 7)], load: async () => {} };
  const opening = createOpening(app, { desk, queue, onLoading() {}, onProblem() {} });
  app.state.route = parseHash("#/room/annotate");
  await opening.begin();
  assert.deepEqual([opening.broken, gone], [7, ["#/room/annotate/7"]]);
});

test("addresses name a project, a mode and a frame", () => {
  const hash = makeHash("a b", "annotate", 3, { uid: "x", empty: null });
  assert.equal(hash, "#/a%20b/annotate/3?uid=x");
  const { project, mode, frame, query } = parseHash(hash);
  assert.deepEqual([project, mode, frame, query.get("uid")], ["a b", "annotate", 3, "x"]);
  assert.deepEqual([parseHash("#/").mode, parseHash("#/room/nonsense/x").mode], ["start", "annotate"]);
  assert.equal(parseHash("#/room/review/x").frame, null);
});
