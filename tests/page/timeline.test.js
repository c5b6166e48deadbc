// The timeline: which places and lanes it shows, and what a click means.

import assert from "node:assert/strict";
import { test } from "node:test";
import * as lanes from "../../web_assets/js/timeline/lanes.js";
import { frameName } from "../../web_assets/js/timeline/reading.js";

const lane = (id, ...spans) => ({
  track_id: id,
  spans: spans.map(([a, b, level = 0, name = "car"]) => [a, b, name, level]),
});
const CAR = lane(12, [10, 19], [20, 29, 3], [40, 40, 1]);

test("zooming keeps the place under the pointer, and ends at the recording and at a few frames", () => {
  const all = lanes.whole(1000);
  const near = lanes.zoomed(all, 4, 600, 1000);
  assert.deepEqual(near, { first: 450, count: 250 });
  assert.deepEqual(lanes.zoomed(near, 0.01, 600, 1000), all);
  assert.equal(lanes.zoomed(near, 1000, 600, 1000).count, 16);
  assert.deepEqual(lanes.zoomed(lanes.whole(5), 10, 2, 5), lanes.whole(5));
  assert.deepEqual(lanes.moved(near, 5000, 1000), { first: 750, count: 250 });
  assert.deepEqual(lanes.moved(near, -5000, 1000), { first: 0, count: 250 });
});

test("a frame that is out of sight comes into the middle, and one in sight moves nothing", () => {
  const near = { first: 450, count: 250 };
  assert.equal(lanes.showing(near, 450, 1000), near);
  assert.equal(lanes.showing(near, 699, 1000), near);
  assert.deepEqual(lanes.showing(near, 800, 1000), { first: 675.5, count: 250 });
  assert.deepEqual(lanes.showing(near, 2, 1000), { first: 0, count: 250 });
});

test("a strip has as many pictures as fit, which stay the same when it is moved", () => {
  assert.deepEqual(
    lanes.pictures(lanes.whole(5), 5, 20).map(({ place }) => place),
    [0, 1, 2, 3, 4],
  );
  const shown = lanes.pictures({ first: 100, count: 100 }, 5000, 26);
  assert.deepEqual(
    [shown[0], shown.at(-1)],
    [
      { place: 100, first: 100, last: 104 },
      { place: 196, first: 196, last: 200 },
    ],
  );
  const moved = lanes.pictures({ first: 101.5, count: 100 }, 5000, 26);
  assert.deepEqual(moved[0], { place: 100, first: 101.5, last: 104 });
  assert.ok(moved.slice(0, -1).every(({ place }) => shown.some((one) => one.place === place)));
  assert.ok(lanes.pictures(lanes.whole(5000), 5000, 26).length <= 26);
  assert.equal(lanes.pictures(lanes.whole(5000), 5000, 26).at(-1).last, 5000);
});

test("only the spans and lanes in sight are drawn", () => {
  assert.deepEqual(lanes.spansIn(CAR, { first: 19.5, count: 10 }), CAR.spans.slice(0, 2));
  assert.deepEqual(lanes.spansIn(CAR, { first: 30, count: 10 }), []);
  const [early, late] = [lane(1, [0, 5]), lane(2, [50, 60])];
  assert.deepEqual(lanes.lanesIn([early, CAR, late], { first: 30, count: 5 }), [CAR], "its gap is in sight");
  assert.deepEqual(lanes.lanesIn([early, CAR, late], { first: 5.5, count: 5 }), [early, CAR]);
});

test("a click means the box under it, else the nearest one within reach, else the frame", () => {
  assert.equal(lanes.placeAt(CAR, 15.3, 2, 100), 15);
  assert.equal(lanes.placeAt(CAR, 9.2, 2, 100), 10);
  assert.equal(lanes.placeAt(CAR, 31.5, 2, 100), 29);
  assert.equal(lanes.placeAt(CAR, 38.5, 2, 100), 40);
  assert.equal(lanes.placeAt(CAR, 34.5, 2, 100), 34);
  assert.equal(lanes.placeAt(CAR, 99.9, Number.POSITIVE_INFINITY, 100), 40);
  assert.equal(lanes.placeAt(null, -3, 2, 100), 0);
  assert.equal(lanes.placeAt(null, 140, 2, 100), 99);
  assert.deepEqual(lanes.spanAt(CAR, 25), [20, 29, "car", 3]);
  assert.equal(lanes.spanAt(CAR, 30), null);
});

test("a lane has the name of the class of most of its boxes, and says what it shows", () => {
  const mixed = lane(4, [0, 1, 0, "van"], [2, 9, 1, "car"]);
  assert.equal(lanes.nameOf(mixed), "car 4");
  assert.equal(lanes.nameOf(lane(null, [0, 1])), "no track");
  assert.equal(lanes.wordsOf(null), "no box");
  assert.deepEqual(
    [0, 1, 3].map((level) => lanes.wordsOf([0, 1, "car", level])),
    ["reviewed", "proposed", "proposed, doubt about 50 %"],
  );
  assert.equal(lanes.describe([CAR, mixed, lane(null, [1, 1])], null, null), "2 tracks");
  assert.equal(
    lanes.describe([CAR], 12, [10, 11]),
    "1 track; car 12: in 21 frames, 10 reviewed, frames 11 to 12 selected",
  );
});

test("a frame is named by its number in the open recording, else by its key", () => {
  const timeline = {
    places: new Map([
      [41, 0],
      [42, 1],
    ]),
  };
  assert.equal(frameName({ timeline }, 42, "000009"), "2");
  assert.equal(frameName({ timeline }, 7, "000009"), "000009");
  assert.equal(frameName({ timeline: null }, 42, "000009"), "000009");
});
