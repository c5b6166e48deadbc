/**
 * Follows the jobs that read boxes of recordings and files, and those that copy projects. The start page has no open
 * project, so it receives no events of these jobs.
 */

import { isActive } from "../jobs.js";

/** @type {Api.Job["kind"][]} */
const KINDS = ["import", "boxes", "copy"];
/** Such a job takes between a moment and minutes, so the interval between requests grows. */
const WAIT_MS = { first: 700, longest: 5000, growth: 1.5 };

/** @param {Api.Job} job */
export const isOfImport = ({ kind }) => KINDS.includes(kind);

/**
 * Requests the jobs once, and then repeatedly while one of them runs.
 *
 * @param {App} app
 * @param {() => void} onDone called when a job has ended.
 * @returns {() => void} ends the requests.
 */
export function followImports(app, onDone) {
  let isOver = false;
  let timer = 0;
  let waitMs = WAIT_MS.first;
  /** @param {Api.Job} job */
  const isImport = (job) => isOfImport(job) && isActive(job);
  const running = () => app.state.jobs.filter(isImport).map(({ id }) => id);

  function plan() {
    clearTimeout(timer);
    const isRunning = running().length > 0 && !isOver;
    timer = isRunning ? setTimeout(look, waitMs) : 0;
    waitMs = isRunning ? Math.min(waitMs * WAIT_MS.growth, WAIT_MS.longest) : WAIT_MS.first;
  }

  async function look() {
    const before = running();
    try {
      /** @type {Api.JobList} */
      const { jobs } = await app.api.get("/api/jobs");
      if (isOver) return;
      // the answer lacks jobs that were started after the request
      const begun = app.state.jobs.filter((job) => isImport(job) && !jobs.some(({ id }) => id === job.id));
      app.state.set({ jobs: [...begun, ...jobs] });
    } catch {
      // another part of the page shows that the server does not answer
    }
    plan();
    if (!isOver && before.some((id) => !running().includes(id))) onDone();
  }

  const stop = app.state.on("jobs", () => timer || plan());
  void look();
  return () => {
    isOver = true;
    plan();
    stop();
  };
}
