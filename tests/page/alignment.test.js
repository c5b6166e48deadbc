/** What is set of an alignment and not kept yet, while frames, answers and others' changes come. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { anglesOf, upOf } from "../../web_assets/js/alignment/level.js";
import * as settings from "../../web_assets/js/alignment/setting.js";

const CORRECTION = { ...settings.NONE, turn_deg: [0, 0, 90], time_offset_s: 0.2 };

const stored = (/** @type {Partial<Api.AlignmentJson>} */ changes = {}) =>
  /** @type {Api.AlignmentJson} */ ({
    recording: 1,
    adjusted: 3,
    correction: settings.NONE,
    up: upOf({ roll: 0, pitch: 10 }),
    images: [
      { frame: 7, seconds: 0 },
      { frame: 6, seconds: -0.21 },
      { frame: 8, seconds: 0.2 },
    ],
    ...changes,
  });

const set = (/** @type {object} */ changes) => ({ ...settings.asStored(stored()), ...changes });

test("roll and pitch are those of their up direction", () => {
  const { roll, pitch } = anglesOf(upOf({ roll: 12, pitch: -30 }));
  assert.ok(Math.abs(roll - 12) < 1e-9 && Math.abs(pitch + 30) < 1e-9);
});

test("what is set stays on another frame of the recording, and not once somebody has adjusted it", () => {
  const before = set({ correction: CORRECTION });
  const beside = stored({ up: upOf({ roll: 0, pitch: 11 }) });
  assert.deepEqual(settings.taken(before, beside), { ...before, stored: beside });
  // what is not set is as this frame has it
  assert.ok(Math.abs(settings.levelOf(settings.taken(before, beside)).pitch - 11) < 1e-9);
  for (const other of [stored({ adjusted: 4 }), stored({ recording: 2 })])
    assert.deepEqual(settings.taken(before, other), settings.asStored(other));
});

test("the correction or the level that is kept leaves the other one as it is shown", () => {
  const level = { roll: 0, pitch: 0 };
  const both = set({ correction: CORRECTION, level });
  const leveled = settings.kept(both, stored({ adjusted: 4, up: upOf(level) }), "up");
  assert.deepEqual([leveled.correction, leveled.level], [CORRECTION, null]);
  const corrected = settings.kept(both, stored({ adjusted: 4, correction: CORRECTION }), "correction");
  assert.equal(corrected.correction, null);
  // the same direction in a camera frame that is turned by 90 degrees about its axis
  const shown = settings.turnedUp(both);
  assert.ok(settings.turnedUp(corrected).every((value, i) => Math.abs(value - shown[i]) < 1e-9));
  assert.ok(Math.abs(shown[0] - 1) < 1e-9);
});

test("a proposal can be made again, so that only what was turned by hand is lost", () => {
  const level = { roll: 5, pitch: 0 };
  assert.equal(settings.isTurnedByHand(set({ level })), true);
  const proposed = set({ level, proposed: {} });
  assert.deepEqual([settings.isTurned(proposed), settings.isTurnedByHand(proposed)], [true, false]);
  assert.equal(settings.isTurned(set({ level: { roll: 0, pitch: 10 } })), false);
});

test("a number of the correction is set alone, and the time offset chooses the image", () => {
  const one = settings.withNumber(CORRECTION, 4, 0.1);
  assert.deepEqual(one, { ...CORRECTION, shift_m: [0, 0.1, 0] });
  assert.equal(settings.isCorrected(set({ correction: one })), true);
  assert.equal(settings.isCorrected(set({ correction: { ...settings.NONE } })), false);
  assert.equal(settings.imageFrame(set({ correction: CORRECTION })), 6);
  assert.equal(settings.imageFrame(set({})), 7);
});
