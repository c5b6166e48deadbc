/** What a job waits for, and which of what is heard of it is newer. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { readJobs, takeJob, waiting } from "../../web_assets/js/jobs.js";
import { fakeApp, held } from "./fakes.js";

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

test("what is heard of a job is newer than answers about it", async () => {
  const { promise, resolve } = held();
  const mine = { id: "1", kind: "import", state: "queued", project: "room" };
  const app = fakeApp({ get: () => promise, state: { jobs: [{ ...mine, id: "0" }] } });
  const read = readJobs(app);
  app.state.set({ jobs: [{ ...mine, state: "done" }, ...app.state.jobs] });
  takeJob(app, mine);
  resolve([
    { ...mine, state: "running" },
    { ...mine, id: "0", state: "failed" },
  ]);
  await read;
  assert.deepEqual(
    app.state.jobs.map(({ id, state }) => [id, state]),
    [
      ["1", "done"],
      ["0", "failed"],
    ],
  );
});
