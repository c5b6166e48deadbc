// How many points the 3D view draws on computers of different speed.

import assert from "node:assert/strict";
import { test } from "node:test";
import { createPace } from "../../web_assets/js/pace.js";

/** Turns the camera for `frames` frames of a computer that takes `us` microseconds for a point; the points drawn. */
function turn(pace, { count, us, frames, from = 0 }) {
  const drawn = [];
  let now = from;
  for (let n = 0; n < frames; n++) {
    pace.moved(now);
    drawn.push(pace.draw(count, now));
    now += Math.max(16, 5 + drawn.at(-1) * us * 1e-3);
  }
  return { drawn, now };
}

test("a slow computer draws as many points as keep 20 frames a second while the camera moves, and all at rest", () => {
  const pace = createPace(60_000);
  const { drawn, now } = turn(pace, { count: 120_000, us: 2, frames: 60 });
  assert.equal(drawn[0], 60_000);
  assert.ok(drawn.at(-1) > 14_000 && drawn.at(-1) < 23_000, `${drawn.at(-1)}`);
  assert.equal(pace.draw(120_000, now + 1000), 120_000);
  // it has become faster
  const { drawn: later } = turn(pace, { count: 120_000, us: 0.5, frames: 60, from: now + 2000 });
  assert.ok(later.at(-1) > 58_000 && later.at(-1) < 91_000, `${later.at(-1)}`);
});

test("a graphics card draws all points always", () => {
  const { drawn } = turn(createPace(Infinity), { count: 900_000, us: 0.001, frames: 60 });
  assert.deepEqual(new Set(drawn), new Set([900_000]));
});

test("pauses of a drag are no slow frames, and a very slow computer draws some points", () => {
  const pace = createPace(60_000);
  for (let now = 0; now < 20_000; now += 250) {
    // three fast frames, then a pause that is shorter than a rest
    for (const at of [0, 16, 32]) {
      pace.moved(now + at);
      assert.equal(pace.draw(50_000, now + at), 50_000);
    }
  }
  const { drawn } = turn(createPace(60_000), { count: 120_000, us: 100, frames: 60 });
  assert.equal(drawn.at(-1), 5000);
});
