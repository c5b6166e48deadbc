/** What a job waits for. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { waiting } from "../../web_assets/js/jobs.js";

const job = (/** @type {Partial<Api.Job>} */ changes) =>
  /** @type {Api.Job} */ ({
    id: "a",
    project: "street",
    kind: "propose",
    state: "queued",
    heavy: true,
    background: false,
    created_ns: 5,
    eta_s: null,
    ...changes,
  });

test("a job that waits names the running one of its lane, how long that takes, and those before it", () => {
  const own = job({});
  const training = job({ id: "b", kind: "train", state: "running", eta_s: 130, created_ns: 1 });
  const others = [
    job({ id: "c", kind: "export", state: "running", heavy: false }),
    job({ id: "d", state: "done" }),
    job({ id: "e", created_ns: 9 }),
    job({ id: "f", created_ns: 2, background: true }),
  ];
  assert.equal(waiting(own, [own, training, ...others]), "Waits for the training, about 2 min 10 s left");
  const first = job({ id: "g", created_ns: 3 });
  assert.equal(
    waiting(own, [own, { ...training, project: "hall", eta_s: null }, first, ...others]),
    "Waits for the training in hall, then for 1 more job",
  );
  assert.equal(waiting(own, [own, first]), "Waits for 1 job");
  assert.equal(waiting(own, [own, ...others]), "About to begin");
});
