/** What to do next in a project, and how far the guide is. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { stepsDone } from "../../web_assets/js/guide.js";
import { nextStep } from "../../web_assets/js/start/start.js";

const project = (/** @type {Record<string, number>} */ labels, framesDone = 0, recordings = 1) =>
  /** @type {Api.ProjectSummary} */ ({ frames: 10, frames_done: framesDone, recordings, labels_by_state: labels });

test("a card says what to do next", () => {
  assert.equal(nextStep(project({}, 0, 0)), null);
  assert.equal(nextStep(project({}))?.text, "Draw the first box");
  assert.equal(nextStep(project({ rejected: 3 }))?.text, "Draw the first box");
  assert.equal(nextStep(project({ proposed: 1, accepted: 2 }, 2))?.text, "Review 1 proposal");
  assert.equal(nextStep(project({ accepted: 2 }, 2))?.text, "Go on with the next frame");
  assert.equal(nextStep(project({ edited: 12 }, 10))?.mode, "export");
});

test("the guide goes from the first box over following and review to an export", () => {
  assert.equal(stepsDone({}, false), 0);
  assert.equal(stepsDone({ proposed: 3 }, false), 0);
  assert.equal(stepsDone({ accepted: 1 }, false), 2);
  assert.equal(stepsDone({ accepted: 1, proposed: 9 }, false), 3);
  assert.equal(stepsDone({ accepted: 9, edited: 1 }, false), 4);
  assert.equal(stepsDone({}, true), 5);
});
